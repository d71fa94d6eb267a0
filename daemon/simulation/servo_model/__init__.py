"""Emulated Dynamixel servos: registers, their effects, and bus packets.

Input and output are bytes with times; there is no port. This package shares only the control table
and the CRC with the client.
"""
