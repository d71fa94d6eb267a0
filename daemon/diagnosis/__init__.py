"""Implement the checks of `softfinger doctor`; each module covers one area and returns findings.

Only the `repair` functions, which `--fix` calls, change hardware or system settings. The hand is
never stiffened or moved.
"""
