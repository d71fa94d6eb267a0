"""Control: the hand's mode and the joints' goals, by grip, setpoints, slip and tasks.

No socket, no servo protocol.
"""
