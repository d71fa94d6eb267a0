"""Control: mode of the hand, grip laws, setpoints, slip monitor and tasks.

This package uses neither sockets nor the servo protocol.
"""
