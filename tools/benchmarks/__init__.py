"""The ``softfinger bench`` command, with one module for each measurement.

Several measurements share the modules `measuring`, `rigs` and `virtual_grip`.
"""
