"""``softfinger bench``: one module for each thing it measures, and what they share.

`measuring`, `picture` and `rigs` know no single measurement; `accuracy` and `faults` are campaigns.
"""
