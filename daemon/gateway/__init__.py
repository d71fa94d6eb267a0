"""The process that holds the sockets which clients reach, so that the loop never touches what they
send.

It alone reads their bytes; it is bounded in memory and in connections, and when it dies all the
same it is started again while the loop goes on. The loop gives it one stream of messages and takes
from it a few checked requests at a time, over a socket pair that never blocks (`link`). It imports
neither NumPy nor the loop.

``zmtp``, ``peers``
    the wire protocol of clients without keys, on sockets of our own: libzmq can bound neither a
    message's parts nor a client's subscriptions, and can't tell what arrived before a stop
``curve``
    clients with keys, by libzmq and pyzmq's authenticator
``admission``
    which request goes to the loop next, and which is refused
"""
