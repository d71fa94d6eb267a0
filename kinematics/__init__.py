"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

Pure mathematics: no clock, no thread, no settings, and no file but the solid tip's data and the
kernels' cache. SI units.
"""
