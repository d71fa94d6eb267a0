"""`softfinger emulate`: the simulated hand behind ptys, as servos and tactile boards."""
