"""`analyse` and `plot`: recorded frames to contacts over time, and pictures of recordings.

The estimate is the daemon's own.
"""
