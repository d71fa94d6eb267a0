"""Offline physics of a fingertip of solid rubber: finite elements, contact, and the data file.

``python -m research.solid_tip LINEAR`` computes small strains, ``python -m
research.solid_tip.strain LINEAR OUT`` what finite strain makes of them, and writes
``kinematics/contact/solid_tip.npz``; `rubber` needs pypardiso. Lengths are in tip radii a,
stresses in E.
"""
