"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

The modules are pure mathematics in SI units. The modules do not use clocks, threads or settings.
The only files that the modules access are the solid-tip data and the cache of compiled kernels.
"""
