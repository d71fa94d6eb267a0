"""Checks of `softfinger doctor`: one module an area, each a few functions that return findings.

Nothing here changes, stiffens or moves anything, but for `repair`, which `--fix` asks for.
"""
