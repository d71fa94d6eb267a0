"""Real-time loop: start-up of the daemon, the tick, client requests, publishing and timing.

This package connects the others. It contains no control law, limit or protocol.
"""
