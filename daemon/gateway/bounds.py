"""All bounds of the gateway: what clients may send, hold and cost; see `docs/security.md`.

Those that a profile sets (`commands.max_bytes`, `commands.per_second`, `stream.queue`) are in
`Config`, which a gateway is given when it is started.
"""

from __future__ import annotations

from typing import NamedTuple

# The process
MEMORY = 128 << 20  # bytes of data, of which Python and libzmq take a third
DESCRIPTORS = 64  # that are not clients'
CLIENTS = 256  # connections, of commands and stream together
STALLED = 3.0  # s of processor time within one step after which the process is ended, …
BLOCKED = 30.0  # … and of any time; a machine that is busy or stops it takes only such time
GAP = 0.05  # s; after a longer gap between polls, requests are dated by the earlier poll

# A connection
HANDSHAKE = 2.0  # s in which a client has to have finished its handshake
QUEUE = 64  # requests, answers or subscriptions of one client that wait in its socket
FRAMES = 4  # times commands.max_bytes, in one part of a message
PARTS = 16  # of a request, with its connection's and those of its envelope, …
ENVELOPE = 1024  # … which have so many bytes
SUBSCRIPTION = 1024  # bytes; the handshake's own messages are longer than any topic
SUBSCRIPTIONS = 64  # read at a time
TELL_AGAIN = 0.1  # s between two times at which late subscribers are told what they missed
KEYS_CHECKED = 0.5  # s between looks at the folder of keys

# A stop
PURGE = 0.02  # s after it in which all requests but a status are refused, and on while they flood
LONGEST_HELD = 0.25  # s that answers wait for that

# Requests
UNDER_WAY = 16  # that the loop has and hasn't answered; …
URGENT = 32  # … and of those that look like a stop, which go beside them …
URGENT_BYTES = 256  # … if they are so short
WAITING_EACH = 64  # of one client that wait here …
WAITING = 2048  # … and of all
ALL_RATE = 2000.0  # a second of all clients together …
LEAST_RATE = 2.0  # … but each may send so many
REST = 0.05  # s without a request after which a client that sent too many is heard again

# Turns
TEND = 0.01  # s between looks at what is due by the time
TURN = 0.004  # s of reading requests, before others
LAST_WORDS = 0.2  # s for subscribers to take what waits when the loop has ended


class Config(NamedTuple):
    """Addresses (an empty one is not bound), bounds, and the stream's topics."""

    stream: str
    commands: str
    topics: list[str]
    queue: int  # messages that wait for a subscriber
    max_bytes: int = 4096  # of a request
    per_second: float = 200.0  # requests of a client
    ipc_mode: int = 0o600  # rights of an ipc address's file
    keys: str = ""  # folder of `softfinger keys`
    stream_key: str = "stream.address"  # what errors call the stream's address
    latest: str = ""  # where the first topic goes out in one frame
