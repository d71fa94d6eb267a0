"""Servos: the interface of every backend, the simulated one, and Dynamixel's on a serial port.

Which name in the settings is which backend stands in `daemon.backends`.
"""
