"""The pages of ``softfinger figures``: modules with the numbers of some figures and their drawing.

A page is drawn from the very sheets that are written as CSV. Nothing here imports matplotlib
before something is drawn.
"""
