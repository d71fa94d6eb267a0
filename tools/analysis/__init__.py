"""From recorded pressure frames to contacts over time: sources, the pass over them, pictures.

What ``softfinger analyse`` and ``softfinger plot`` are made of. The estimate is the daemon's own.
"""
