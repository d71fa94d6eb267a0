"""The process that holds the sockets which clients reach: the loop never touches what they send.

It is bounded in memory and connections, and started again when it dies. It gives the loop a few
checked requests at a time, and takes one stream of messages, over a socket pair that never blocks
(`wire.loop_link`). Clients without keys are served on sockets of our own (`zmtp`, `connections`,
`endpoints`), since libzmq can bound neither a message's parts nor a client's subscriptions, and
can't say what arrived before a stop; those with keys by libzmq (`curve`). All bounds: `bounds`.
It imports neither NumPy nor the loop.
"""
