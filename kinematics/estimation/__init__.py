"""Estimation of displacement, tilts, gain and their covariance from one pressure frame.

The public class is in `estimator`. The other modules are the stages of the estimator, mostly
implemented as kernels.
"""
