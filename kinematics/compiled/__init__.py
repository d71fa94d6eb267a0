"""Compilation and storage of kernels, and their record types.

The package is independent of the computations in the kernels.
"""
