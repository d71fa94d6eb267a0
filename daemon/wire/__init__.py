"""The stream and the commands as bytes: schema, packing, sockets, keys.

The process that holds the clients' connections is `gateway`.
"""
