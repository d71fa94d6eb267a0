"""Define the safety limits of the hand, check them on each tick, and track the torque state.

To add a limit, write a check function in `safety.limits` and decorate it with a `Limit`. This
package does not plan the hand's motion.
"""
