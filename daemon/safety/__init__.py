"""Every limit of the hand, how it is checked each tick, and the torque state it ends in.

A new limit is a row of `safety.limits.LIMITS` above its check; nothing here decides where the hand
goes.
"""
