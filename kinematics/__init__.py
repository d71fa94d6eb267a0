"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

Pure mathematics: no input or output, no clock, no thread, no settings. SI units.
"""
