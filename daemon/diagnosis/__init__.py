"""Implement the `softfinger doctor` checks; each module covers one area and returns findings.

Only the `repair` functions, which `--fix` calls, change hardware or system settings. No check or
repair switches torque on or moves the hand.
"""
