"""The ``softfinger bench`` command, with one module for each measurement.

`measuring`, `rigs` and `virtual_grip` are shared by several measurements.
"""
