"""Define the gateway's limits for messages, queues, rates and memory; see `docs/security.md`.

The profile's limits (`commands.max_bytes`, `commands.per_second`, `stream.queue`) are part of
`Config`, which is passed to the gateway at startup.
"""

from __future__ import annotations

from typing import NamedTuple

# The process
MEMORY_MAX = 128 << 20  # data segment limit [bytes]; Python and libzmq use a third of this limit
DESCRIPTOR_COUNT = 64  # number of file descriptors in addition to one for each client
CLIENT_COUNT_MAX = 256  # maximum number of command and stream connections combined
STEP_CPU_TIME_MAX = 3.0  # CPU time limit for one step [s], enforced by the kernel
# Limit on the elapsed time of one step [s]. On a busy machine, the process waits for a processor,
# so the elapsed time exceeds the CPU time.
STEP_TIME_MAX = 30.0
# Longest normal interval between two polls [s]. After a longer interval, the gateway stamps new
# requests with the time of the previous poll.
POLL_GAP_MAX = 0.05

# Connections
HANDSHAKE_TIMEOUT = 2.0  # s
SOCKET_QUEUE_LENGTH = 64  # maximum number of messages in each libzmq queue of a client
# Size limit of one part of a request, as a multiple of commands.max_bytes. The limit is at least
# SUBSCRIPTION_SIZE_MAX, because libzmq also applies it to the handshake.
PART_SIZE_RATIO = 4
PART_COUNT_MAX = 16  # maximum number of parts in a request, including routing frame and envelope
ENVELOPE_SIZE_MAX = 1024  # maximum combined size of routing frame and envelope [bytes]
HANDSHAKES_PER_TURN = 64  # maximum number of handshakes in a step
SUBSCRIPTION_SIZE_MAX = 1024  # maximum size of a subscription or a handshake message [bytes]
SUBSCRIPTIONS_PER_TURN = 64
REPEAT_INTERVAL = 0.1  # minimum time between repetitions of messages for late subscribers [s]
KEY_CHECK_INTERVAL = 0.5  # time between checks of the key folder [s]

# Time after a stop during which only status requests are accepted [s]. A flood of requests extends
# this time.
REFUSAL_TIME = 0.02
ANSWER_DELAY_MAX = 0.25  # maximum delay of replies after a stop [s]

# Requests
UNANSWERED_MAX = 16  # maximum number of requests that await the loop's reply
# Maximum number of urgent requests (apparent stops) that await the loop's reply.
URGENT_UNANSWERED_MAX = 32
URGENT_SIZE_MAX = 256  # size limit of an urgent request [bytes]
CLIENT_QUEUE_LENGTH = 64  # maximum number of queued requests per client
TOTAL_QUEUE_LENGTH = 2048  # maximum number of queued requests, all clients combined
TOTAL_RATE = 2000.0  # maximum number of requests per second, all clients combined
CLIENT_RATE_MIN = 2.0  # guaranteed number of requests per second for each client
# A flooding client's requests are accepted again once it may send the requests of this time [s].
RECOVERY_TIME = 0.05
# Time after a restart of the gateway in which clients may deliver requests that they have queued in
# the meantime [s]. libzmq reconnects after 0.1 s.
RECONNECT_TIME = 1.0

# Steps
STEP_WAIT_MAX = 0.01  # maximum time that a step waits for messages [s]
TURN_TIME = 0.004  # time limit for reading requests in a step [s]
LINGER_TIME = 0.2  # time limit for sending queued messages after the loop has ended [s]

READY = "ready"  # text that the process prints once its sockets are bound


class Config(NamedTuple):
    """Addresses, limits and stream topics of a gateway.

    If an address is empty, the gateway does not open that socket.
    """

    stream: str
    commands: str
    topics: list[str]
    queue: int  # maximum number of queued messages per subscriber
    max_bytes: int = 4096  # request size limit
    per_second: float = 200.0  # request rate limit per client
    ipc_mode: int = 0o600  # permissions of an ipc socket file
    keys: str = ""  # folder created by `softfinger keys`
    stream_setting: str = "stream.address"  # setting name in errors about the stream address
    latest: str = ""  # address on which the first topic is published in single-frame messages
    restarted: bool = False  # True if an earlier gateway process has exited
    stops: int = 0  # stop count that the earlier gateway process confirmed
