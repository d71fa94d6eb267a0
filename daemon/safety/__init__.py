"""Safety limits of the hand, their checks on each tick, and the torque state.

To add a limit, place its row for `safety.limits.LIMITS` above its check function. This package does
not plan the hand's motion.
"""
