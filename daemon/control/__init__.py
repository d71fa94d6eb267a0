"""Implement the hand's modes, grip control laws, setpoints, slip monitor and tasks.

This package does not use sockets or the servo protocol.
"""
