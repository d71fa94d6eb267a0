"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

The modules are pure mathematics in SI units. They use no clocks, threads or settings, and the only
files are the data of the solid tip and the cache of compiled kernels.
"""
