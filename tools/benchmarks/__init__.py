"""The command ``softfinger bench``: one module for each measurement, and shared modules.

The shared modules are `measuring`, `rigs` and `virtual_grip`.
"""
