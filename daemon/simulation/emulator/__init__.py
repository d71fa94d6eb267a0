"""`softfinger emulate`: the simulated hand as servos and tactile boards on ptys.

The package handles ports, transmission times, framings and injected faults. The servos themselves
are in `servo_model`.
"""
