"""The tick and what makes it run: building the daemon, requests, publishing, timing, warm-up.

The one room that knows every other; no control law, limit or protocol stands here.
"""
