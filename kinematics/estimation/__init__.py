"""Estimation of displacement, tilts, gain and their covariance from one pressure frame.

`estimator` holds the public class. The other modules are the stages of the estimator, mostly as
kernels.
"""
