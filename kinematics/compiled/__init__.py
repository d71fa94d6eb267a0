"""Compile and cache kernels, and define the record types for their arguments.

The package is independent of the computations in the kernels.
"""
