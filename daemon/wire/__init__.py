"""Define how the stream and the commands are sent: schema, packing, sockets and keys.

The `gateway` package contains the process that serves the client connections.
"""
