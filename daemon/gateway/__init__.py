"""Serve all clients from a separate gateway process, which enforces the limits in `bounds`.

The loop sends the stream to the gateway over `wire.loop_link`. The gateway forwards client requests
to the loop, a few at a time.
"""
