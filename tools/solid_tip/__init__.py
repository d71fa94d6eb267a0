"""Offline physics of a fingertip of solid rubber: finite elements, contact, and the data file.

A development tool, ``python -m softfinger.tools.solid_tip``: nothing here is needed at run time.
It writes ``kinematics/contact/solid_tip.npz``. Lengths are in tip radii a, stresses in E.
"""
