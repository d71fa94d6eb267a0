"""Emulate the registers and bus packets of Dynamixel servos.

The input and output are bytes with time stamps, so no port is needed. The package and the client
share only the control table and the CRC.
"""
