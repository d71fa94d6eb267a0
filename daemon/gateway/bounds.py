"""Limits of the gateway for messages, queues, rates and memory; see `docs/security.md`.

The limits that a profile sets (`commands.max_bytes`, `commands.per_second`, `stream.queue`) are in
`Config`, which the gateway receives at its start.
"""

from __future__ import annotations

from typing import NamedTuple

# The process
MEMORY = 128 << 20  # bytes of data; Python and libzmq use a third of it
DESCRIPTORS = 64  # file descriptors besides those of clients
CLIENTS = 256  # connections for commands and stream together
STALLED = 3.0  # s of CPU time within one step, after which the kernel ends the process
BLOCKED = 30.0  # s of elapsed time likewise; longer, since a busy machine delays the process
GAP = 0.05  # s; after a longer gap between polls, requests are dated to the earlier poll

# A connection
HANDSHAKE = 2.0  # s, timeout of the handshake
QUEUE = 64  # requests, answers or subscriptions of one client, queued in its socket
FRAMES = 4  # size limit of one message part, in units of commands.max_bytes
PARTS = 16  # parts of a request, including the routing frame and the envelope
ENVELOPE = 1024  # bytes of the routing frame and the envelope
SUBSCRIPTION = 1024  # bytes; messages of the handshake are longer than any topic
SUBSCRIPTIONS = 64  # read in one turn
TELL_AGAIN = 0.1  # s between two repetitions of messages for late subscribers
KEYS_CHECKED = 0.5  # s between two checks of the key folder

# A stop
PURGE = 0.02  # s after a stop for which requests are refused, except status; repeated in a flood
LONGEST_HELD = 0.25  # s for which answers wait for the end of that time

# Requests
UNDER_WAY = 16  # requests that the loop has not answered yet
URGENT = 32  # likewise of requests that look like a stop, which are counted separately
URGENT_BYTES = 256  # size limit of a request that counts as urgent
WAITING_EACH = 64  # queued requests of one client
WAITING = 2048  # queued requests of all clients
ALL_RATE = 2000.0  # requests per second of all clients together
LEAST_RATE = 2.0  # requests per second that every client may send
REST = 0.05  # s without a request, after which a client above its rate is accepted again

# Turns
TEND = 0.01  # s, longest wait of a step
TURN = 0.004  # s of reading requests in one step
LAST_WORDS = 0.2  # s for which queued messages are still sent after the loop has ended


class Config(NamedTuple):
    """Addresses (an empty one is not bound), limits, and the topics of the stream."""

    stream: str
    commands: str
    topics: list[str]
    queue: int  # messages queued for one subscriber
    max_bytes: int = 4096  # of a request
    per_second: float = 200.0  # requests of one client
    ipc_mode: int = 0o600  # permissions of the file of an ipc address
    keys: str = ""  # folder of `softfinger keys`
    stream_key: str = "stream.address"  # name of the stream's address in error messages
    latest: str = ""  # address that publishes the first topic in one frame
