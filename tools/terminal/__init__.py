"""`monitor` and `send`: the running daemon from a terminal, and what the live page is drawn with."""
