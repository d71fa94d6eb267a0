"""Implement the real-time loop: daemon startup, tick, client requests, publishing and timing.

This package connects the daemon's other packages, which define control laws, limits and protocols.
"""
