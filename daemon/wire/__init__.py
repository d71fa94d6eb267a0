"""Wire format and transport of the stream and the commands: schema, packing, sockets, keys.

The process that holds the clients' connections is in `gateway`.
"""
