"""The paper's figures and comparisons: the commands `figures` and `validate`.

Each figure is drawn from the same sheets that are written as CSV. matplotlib is imported only when
a figure is drawn.
"""
