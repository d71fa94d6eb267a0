"""Emulate Dynamixel servos: registers, their effects, and bus packets.

The input and output are bytes with time stamps, so no port is needed. The only code that this
package shares with the client is the control table and the CRC.
"""
