"""From one frame of pressures to the contact under it: displacement, tilts, gain, covariance.

The stages of the estimator, mostly kernels; `estimator` is the public face.
"""
