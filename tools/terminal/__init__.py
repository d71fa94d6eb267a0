"""`monitor` and `send`: the running daemon from a terminal, and the parts of the live page."""
