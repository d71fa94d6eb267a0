"""Servo backends: their common interface, simulated servos, and Dynamixel servos on a serial port.

`daemon.backends` maps the names in the settings to them.
"""
