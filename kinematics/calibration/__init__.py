"""Calibrate sensors and tips from frames and test presses: curves, centre, modulus and models.

This package contains only the mathematics. The `tools.calibration` package handles the files and
the procedure.
"""
