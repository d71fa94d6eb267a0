"""Compilation and storage of kernels, and the SIMD and memory helpers they share.

Nothing here knows what a kernel computes.
"""
