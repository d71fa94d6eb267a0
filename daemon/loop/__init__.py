"""Real-time loop: daemon startup, tick, client requests, publishing and timing.

This package connects the other packages. Control laws, limits and protocols are defined there.
"""
