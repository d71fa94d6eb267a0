"""Implement ``softfinger bench``. Each measurement has its own module.

Several measurements share the modules `measuring`, `rigs` and `virtual_grip`.
"""
