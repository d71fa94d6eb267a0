"""Implement the `figures` and `validate` commands.

`figures` reproduces the paper's figures, and `validate` compares the model with published values.
The data of each figure are also written as CSV files. matplotlib is imported only when a figure is
drawn.
"""
