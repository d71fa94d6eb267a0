"""Estimation of a contact from one frame of pressures: displacement, tilts, gain, covariance.

The estimator's stages, mostly kernels, and the calibration that uses it; `estimator` is public.
"""
