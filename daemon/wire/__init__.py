"""Define the schema, packing, sockets and keys for stream messages and commands.

The `gateway` package contains the process that serves the client connections.
"""
