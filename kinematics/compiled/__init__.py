"""Compilation and caching of kernels, and their record types.

The package is independent of the computations in the kernels.
"""
