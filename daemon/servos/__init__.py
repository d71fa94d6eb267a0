"""Servo backends: common interface, simulated servos, and Dynamixel servos on a serial port.

`daemon.backends` maps the backend names in the settings to the backend classes.
"""
