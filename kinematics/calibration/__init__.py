"""Calibration of sensors and tips: curves, centre, modulus and laws from frames and test presses.

This package contains only the mathematics; files and the procedure are in `tools.calibration`.
"""
