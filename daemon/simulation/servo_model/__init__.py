"""Emulated Dynamixel servos: registers, their effects, and the packets on the bus.

The input are bytes with times, the output are bytes; there is no port. The package shares only the
control table and the CRC with the client.
"""
