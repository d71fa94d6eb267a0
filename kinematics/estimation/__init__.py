"""From one frame of pressures to the contact under it: displacement, tilts, gain, covariance.

The estimator's stages, mostly kernels, and the calibration that uses it; `estimator` is public.
"""
