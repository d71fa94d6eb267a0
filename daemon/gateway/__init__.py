"""Serve all clients from a separate gateway process, which enforces the limits in `bounds`.

The loop sends the stream to the gateway over `wire.loop_link` and receives a few client requests at
a time.
"""
