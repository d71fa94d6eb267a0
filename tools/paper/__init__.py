"""`figures`: the pages of the paper's figures, their numbers and their drawing.

A page is drawn from the very sheets that are written as CSV. Nothing here imports matplotlib
before something is drawn.
"""
