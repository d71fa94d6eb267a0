"""Gateway process: it holds the sockets of all clients and enforces the limits of `bounds`.

Over `wire.loop_link` the loop sends it the stream and receives a few requests at a time.
"""
