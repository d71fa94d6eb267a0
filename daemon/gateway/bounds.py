"""Limits of the gateway for messages, queues, rates and memory; see `docs/security.md`.

The limits that a profile sets (`commands.max_bytes`, `commands.per_second`, `stream.queue`) are in
`Config`, which the gateway receives at its start.
"""

from __future__ import annotations

from typing import NamedTuple

# The process
MEMORY_MAX = 128 << 20  # bytes of data; Python and libzmq use a third of it
DESCRIPTOR_COUNT = 64  # file descriptors besides those of clients
CLIENT_COUNT_MAX = 256  # connections for commands and stream together
STEP_CPU_TIME_MAX = 3.0  # s of CPU time within one step, after which the kernel ends the process
STEP_TIME_MAX = 30.0  # s of elapsed time likewise; longer, since a busy machine delays the process
POLL_GAP_MAX = 0.05  # s; after a longer gap between polls, requests are dated to the earlier poll

# A connection
HANDSHAKE_TIMEOUT = 2.0  # s, timeout of the handshake
SOCKET_QUEUE_LENGTH = 64  # requests, answers or subscriptions of one client, queued in its socket
PART_SIZE_RATIO = 4  # size limit of one message part, in units of commands.max_bytes
PART_COUNT_MAX = 16  # parts of a request, including the routing frame and the envelope
ENVELOPE_SIZE_MAX = 1024  # bytes of the routing frame and the envelope
SUBSCRIPTION_SIZE_MAX = 1024  # bytes; messages of the handshake are longer than any topic
SUBSCRIPTIONS_PER_TURN = 64  # read in one turn
REPEAT_INTERVAL = 0.1  # s between two repetitions of messages for late subscribers
KEY_CHECK_INTERVAL = 0.5  # s between two checks of the key folder

# A stop
# s after a stop for which requests are refused, except status; repeated in a flood.
REFUSAL_TIME = 0.02
ANSWER_DELAY_MAX = 0.25  # s for which answers wait for the end of that time

# Requests
UNANSWERED_MAX = 16  # requests that the loop has not answered yet
# likewise of requests that look like a stop, which are counted separately.
URGENT_UNANSWERED_MAX = 32
URGENT_SIZE_MAX = 256  # size limit of a request that counts as urgent
CLIENT_QUEUE_LENGTH = 64  # queued requests of one client
TOTAL_QUEUE_LENGTH = 2048  # queued requests of all clients
TOTAL_RATE = 2000.0  # requests per second of all clients together
CLIENT_RATE_MIN = 2.0  # requests per second that every client may send
RECOVERY_TIME = 0.05  # s without a request, after which a client above its rate is accepted again

# Turns
STEP_WAIT_MAX = 0.01  # s, longest wait of a step
TURN_TIME = 0.004  # s of reading requests in one step
LINGER_TIME = 0.2  # s for which queued messages are still sent after the loop has ended


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
