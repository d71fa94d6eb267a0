"""Offline physics of a fingertip of solid rubber: finite elements, contact, and the data file.

``python -m research.solid_tip`` writes ``kinematics/contact/solid_tip.npz``. Lengths are in
tip radii a, stresses in E.
"""
