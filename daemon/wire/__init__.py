"""Define wire format and transport of stream and commands: schema, packing, sockets and keys.

The `gateway` package contains the process that serves the client connections.
"""
