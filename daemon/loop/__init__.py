"""Implement the real-time loop: daemon startup, tick, client requests, publishing and timing.

This package connects the daemon's other packages. They define the control laws, limits and
protocols.
"""
