"""Calibration of sensors and tips from frames and test presses: curves, centre, modulus and models.

This package contains only the mathematics. Files and the procedure are in `tools.calibration`.
"""
