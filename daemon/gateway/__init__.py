"""The process that holds the clients' sockets and alone reads what they send, within `bounds`.

The loop gives it the stream and takes a few checked requests at a time, over `wire.loop_link`.
"""
