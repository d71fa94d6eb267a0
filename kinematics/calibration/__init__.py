"""What a sensor's calibration and a tip's test presses tell: curves, centre, modulus, laws.

Numbers alone: files and steps are in `tools.calibration`.
"""
