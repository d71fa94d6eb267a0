"""Compute the data file of a solid rubber fingertip with finite elements.

``python -m research.solid_tip LINEAR`` computes the small-strain model. ``python -m
research.solid_tip.strain LINEAR OUT`` adds the effect of finite strain and writes the data file.
The data file is installed as ``kinematics/contact/solid_tip.npz``. The `rubber` module needs
pypardiso. Lengths are in units of the tip radius a, and stresses in units of E.

1. Small strain: the program computes the response to loads on surface rings, one Fourier harmonic
   at a time. Contact with the tilted plane is a linear complementarity problem. The problem is
   solved for all combinations of 19 depths, 9 tilts and 4 values of ν.
2. Finite strain: upright presses use a fine mesh at three values of ν. Tilted presses use a
   half-body mesh of 8 × 8 × 6 elements at ν = 0.475. The result is the ratio of neo-Hookean to
   linear presses on the same mesh, so the mesh error of 0.5 to 2 % of N cancels.
3. Fit: one polynomial is fitted to energies and normal forces together. A few modes per harmonic
   represent the base pressure.
"""
