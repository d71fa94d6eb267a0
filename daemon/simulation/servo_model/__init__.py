"""Emulate Dynamixel servos: registers, their effects, and bus packets.

The input and output are bytes with times, so no port is needed. This package and the client share
only the control table and the CRC.
"""
