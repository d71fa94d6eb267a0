"""Every limit of the hand, how it is checked each tick, and the torque state it ends in."""
