"""Implement `softfinger emulate`, the simulated hand with servos and tactile boards on ptys.

This package handles ports, transmission times, framing and injected faults. The servos are in
`servo_model`.
"""
