"""The tick and what makes it run: building the daemon, clock, rates, timing, publishing, warm-up.

The one room that knows every other; no control law, limit or protocol stands here.
"""
