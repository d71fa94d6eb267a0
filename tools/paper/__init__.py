"""The `figures` and `validate` commands, which reproduce the paper's figures and published values.

Each figure is drawn from the same sheets that are written as CSV. matplotlib is imported only when
a figure is drawn.
"""
