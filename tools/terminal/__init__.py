"""The live page of `softfinger monitor` in a terminal, and what it is drawn with."""
