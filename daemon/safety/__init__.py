"""Limits of the hand, their checks at each tick, and the torque state.

A new limit is a row of `safety.limits.LIMITS` placed above its check function. This package does
not decide where the hand moves.
"""
