"""How kernels are compiled and kept, and the SIMD and memory helpers they share.

Nothing here knows what a kernel computes.
"""
