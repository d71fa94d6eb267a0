"""Compilation and caching of kernels, and their record types.

The package does not depend on what the kernels compute.
"""
