"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

The modules contain only mathematics, in SI units, and do not use clocks, threads or settings. They
access no files except the solid-tip data and the cache of compiled kernels.
"""
