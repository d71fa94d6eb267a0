"""Servos: the interface of every backend, the simulated one, and Dynamixel's on a serial port.

`daemon.backends` maps the settings' names to them.
"""
