"""``softfinger bench``: one module for each thing it measures, and what they share.

`measuring`, `rigs` and `virtual_grip` know no single measurement.
"""
