"""Offline computation of a solid rubber fingertip: finite elements, contact, and the data file.

``python -m research.solid_tip LINEAR`` computes the small-strain law. ``python -m
research.solid_tip.strain LINEAR OUT`` adds the effect of finite strain and writes the data file,
which is installed as ``kinematics/contact/solid_tip.npz``. The module `rubber` needs pypardiso.
Lengths are in tip radii a and stresses in E.

1. Small strain: responses to loads on rings of the surface, by Fourier harmonics. Contact with the
   tilted plane is a linear complementarity problem, solved at 19 depths × 9 tilts × 4 values of ν.
2. Finite strain: upright presses on a fine mesh at three ν; tilted presses on 8 × 8 × 6 elements of
   half a body at ν = 0.475. Only the ratio of neo-Hookean to linear presses on the same mesh is
   used, so the error of the mesh (0.5 to 2 % of N) cancels.
3. Fit: one polynomial is fitted to energies and pushes together, and a few modes per harmonic
   represent the base pressure.
"""
