"""The `figures` and `validate` commands, which reproduce the paper's figures and published values.

The sheets that a figure is drawn from are also written as CSV files. matplotlib is imported only
when a figure is drawn.
"""
