"""Serve all clients from a separate gateway process, which enforces the limits in `bounds`.

The loop sends the stream to the gateway over `wire.loop_link`. In return, the loop receives client
requests, a few at a time.
"""
