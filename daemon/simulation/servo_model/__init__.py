"""Emulated Dynamixel servos: their registers, what these do, and the packets on their bus.

Bytes and times in, bytes out: no port, and no code of the client but the control table and CRC.
"""
