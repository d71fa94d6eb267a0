"""Implement `softfinger emulate`, which provides a simulated hand on pseudo-terminals.

This package handles ports, transmission times, framing and injected faults. The `servo_model`
package emulates the servos.
"""
