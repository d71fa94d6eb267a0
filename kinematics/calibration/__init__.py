"""Calibration of sensors and tips: curves, centre, modulus and laws from frames and test presses.

Numbers alone: files and steps are in `tools.calibration`.
"""
