"""`softfinger emulate`: the simulated hand behind ptys, as servos and tactile boards.

Ports, the wire's time, framings, and faults on request; what servos do is in `servo_model`.
"""
