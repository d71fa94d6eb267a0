"""Which mode the hand is in and which goal it gives the joints: grip, setpoints, slip, tasks.

No socket, no servo protocol.
"""
