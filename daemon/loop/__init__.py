"""The tick and what makes it run: building the daemon, requests, publishing, timing, warm-up.

It joins the other rooms; no control law, limit or protocol stands here.
"""
