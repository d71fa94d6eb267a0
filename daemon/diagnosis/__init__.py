"""Checks of `softfinger doctor`: one module per area, with functions that return findings.

Only the `repair` functions, which `--fix` calls, change anything. No function stiffens or moves the
hand.
"""
