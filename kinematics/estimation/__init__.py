"""Estimate displacement, tilts and gain, with their covariance, from one pressure frame.

The public class is in `estimator`. The other modules implement the stages of the estimator, mostly
as kernels.
"""
