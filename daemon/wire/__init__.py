"""Define the wire format and transport of stream and commands: schema, packing, sockets, keys.

The `gateway` package contains the process that serves the client connections.
"""
