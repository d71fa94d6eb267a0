"""Implement `softfinger emulate`, which provides a simulated hand on pseudo-terminals.

This package manages the ports and simulates transmission times, framing and faults. The
`servo_model` package emulates the servos.
"""
