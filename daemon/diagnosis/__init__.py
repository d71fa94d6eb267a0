"""Implement the `softfinger doctor` checks; each module covers one area and returns findings.

Only the `repair` functions, which `--fix` calls, change hardware or system settings. Checks and
repairs never switch torque on or move the hand.
"""
