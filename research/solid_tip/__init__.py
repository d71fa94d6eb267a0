"""Offline physics of a fingertip of solid rubber: finite elements, contact, and the data file.

``python -m research.solid_tip LINEAR`` computes small strains, ``python -m
research.solid_tip.strain LINEAR OUT`` what finite strain makes of them, and writes
``kinematics/contact/solid_tip.npz``; `rubber` needs pypardiso. Lengths are in tip radii a,
stresses in E.

1. Small strains: responses to loads on rings of the surface, by Fourier harmonics; contact with the
   tilted plane as a linear complementarity problem, at 19 depths × 9 tilts × 4 values of ν.
2. Finite strain: upright on a fine mesh at three ν, tilted on 8 × 8 × 6 elements of half a body
   at ν = 0.475. Only the ratio of neo-Hookean to linear presses on the same mesh is used: the
   mesh's own error (0.5 to 2 % of N) cancels.
3. One polynomial fits energies and pushes together; a few modes for each harmonic carry the base
   pressure.
"""
