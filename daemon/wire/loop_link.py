"""Connect the loop and the gateway by a socket pair; define the messages and the loop's end.

Each message is a msgpack list whose first element is the message kind. Sending never blocks. If the
socket buffer is full, the remaining bytes are sent later. While bytes remain, stream messages are
dropped, but replies and stops are queued. The gateway limits the number of pending requests, so the
queue of replies and stops is bounded.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack

# From the loop
PUBLISH = "publish"  # topic index, number of messages to keep for late subscribers, message
REPLY = "reply"  # the request's `Ask.urgent` and `Ask.route`, reply
FENCE = "fence"  # stop count so far

# From the gateway
READY = "ready"  # the sockets are bound
FAILED = "failed"  # bind error
ASK = "ask"  # the `Ask` fields
REPORT = "report"  # `Link.wanted`, `Link.refused`, `Link.stops`
NOTICE = "notice"  # warning text

RESTART_STATUS = 3  # exit status of a gateway that must be restarted and has reported the reason

_BUFFER_SIZE = 1 << 20  # requested socket buffer size [bytes]; the kernel may allow less
_CHUNK = 1 << 16  # maximum number of bytes per receive call
_MESSAGE_SIZE_MAX = 64 << 20  # maximum message size [bytes]
_NOTICE_COUNT_MAX = 20
_FIRST, _AGAIN = (msgpack.packb("again") + msgpack.packb(again) for again in (False, True))


class Ask(NamedTuple):
    """A client's request that satisfies all limits but has not been unpacked yet.

    ``came`` is the arrival time according to `machine_time`. ``stops`` is the number of stops that
    certainly arrived before the request. An ``urgent`` request looks like a stop. ``name`` is the
    client name that belongs to the client's key. ``route`` is the return route for the reply. The
    first part of the route identifies the connection.
    """

    came: float
    stops: int
    urgent: bool
    name: str
    route: list[bytes]
    payload: bytes


def machine_time() -> float:
    """Return the monotonic time [s], including time spent in suspend."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pair() -> tuple[socket.socket, socket.socket]:
    """Create a socket pair and return both ends: the loop's and the gateway's."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_SIZE)
    return ends


def repeated(message: bytes) -> bytes:
    """Return a stream message after setting its ``again`` field, if this field exists."""
    return message.replace(_FIRST, _AGAIN, 1)


class Channel:
    """One end of the socket pair, non-blocking."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._unsent = bytearray()
        self._unpacker = msgpack.Unpacker(max_buffer_size=_MESSAGE_SIZE_MAX)
        self.over = False  # True once the other end has disconnected

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, *message: object, droppable: bool = False) -> None:
        """Send a message. If the buffer is full, queue the message, or drop it if ``droppable``."""
        if self._unsent and not self.flush() and droppable:
            return
        self._unsent += msgpack.packb(message)
        self.flush()

    def flush(self) -> bool:
        """Send queued bytes; return True if the queue is then empty."""
        try:
            while self._unsent:
                del self._unsent[: self._end.send(self._unsent)]
        except BlockingIOError:
            return False
        except OSError:
            self.over = True
            self._unsent.clear()
        return True

    def receive(self) -> Iterator[list[Any]]:
        """Yield received messages; read at most `_CHUNK` bytes per call."""
        try:
            chunk = self._end.recv(_CHUNK)
            self.over = self.over or not chunk
            self._unpacker.feed(chunk)
        except BlockingIOError:
            pass
        except OSError:
            self.over = True
        yield from self._unpacker

    def close(self) -> None:
        self._end.close()


class Link:
    """The loop's end. Only the loop's thread may call its methods, except for `offer`."""

    def __init__(self) -> None:
        self.wanted = 0  # bit mask of topics with subscribers
        self.refused = 0  # number of requests that the gateway's rate and queue limits refused
        self.stops = 0  # stop count with which the gateway stamps new requests
        self.asked: deque[Ask] = deque()  # received requests, with urgent requests first
        self.unpacked: deque[tuple[Ask, dict[str, Any]]] = deque()  # queued for a later tick
        self.notices: deque[str] = deque(maxlen=_NOTICE_COUNT_MAX)  # gateway warnings
        self.called = False  # True if the descriptor passed to `watch` is readable
        self._other = -1  # the descriptor passed to `watch`
        self._fence = 0
        # Last messages of each topic, for a restarted gateway.
        self._kept: dict[int, deque[bytes]] = {}
        self._channel: Channel | None = None
        self._offered: Channel | None = None
        self._poll = select.poll()

    def offer(self, channel: Channel) -> None:
        """Switch to this channel at the next `look`. Any thread may call this method."""
        self._offered = channel

    def watch(self, descriptor: int) -> None:
        """Poll an additional descriptor; `look` sets `called` when the descriptor is readable."""
        self._other = descriptor
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Read the gateway's messages; this takes less than 1 µs if no message has arrived."""
        # The supervisor read the first message, and its receive call may have buffered further
        # messages.
        has_more = self._offered is not None
        if self._offered is not None:
            self._adopt(self._offered)
        ready = [descriptor for descriptor, _ in self._poll.poll(0)]
        self.called = self._other in ready
        if self._channel is None:
            return
        self._channel.flush()
        if has_more or self._channel.fileno() in ready:
            for kind, *fields in self._channel.receive():
                if kind == ASK:
                    ask = Ask(*fields)
                    (self.asked.appendleft if ask.urgent else self.asked.append)(ask)
                elif kind == REPORT:
                    self.wanted, self.refused, self.stops = fields
                else:
                    self.notices.extend(fields)
        if self._channel.over:
            self._disconnect()

    def wait(self, seconds: float) -> None:
        """Wait up to ``seconds`` for a message, then call `look`.

        Do not call this method within a tick.
        """
        self.look()
        channels = [] if self._channel is None else [self._channel]
        select.select(channels, [], [], seconds)
        self.look()

    def wait_for_room(self, seconds: float) -> None:
        """Wait until all bytes have been sent. Do not call this method within a tick.

        Give up if the gateway does not read any bytes for ``seconds``.
        """
        self.look()
        if (channel := self._channel) is not None:
            while not channel.flush() and select.select([], [channel], [], seconds)[1]:
                pass

    def _adopt(self, channel: Channel) -> None:
        """Switch to a new gateway's channel; send the last stop count and the stored messages."""
        self._disconnect()
        self._offered, self._channel = None, channel
        self._poll.register(channel, select.POLLIN)
        for topic, kept in self._kept.items():
            for message in kept:
                channel.send(PUBLISH, topic, kept.maxlen, repeated(message))
        self.fence(self._fence)

    def _disconnect(self) -> None:
        if self._channel is not None:
            self._poll.unregister(self._channel)
            self._channel.close()
            self._channel = None
        self.wanted = self.stops = 0
        self.asked.clear()
        self.unpacked.clear()

    def fence(self, stops: int) -> None:
        """Send the current stop count to the gateway, which stamps requests with this count."""
        self._fence = stops
        if self._channel is not None and stops:
            self._channel.send(FENCE, stops)

    def reply(self, ask: Ask, reply: bytes) -> None:
        if self._channel is not None:
            self._channel.send(REPLY, ask.urgent, ask.route, reply)

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        """Publish a message; repeat the topic's last ``keep`` messages to late subscribers."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(message)
        if self._channel is not None:
            self._channel.send(PUBLISH, topic, keep, message, droppable=True)

    def close(self) -> None:
        """Disconnect. The gateway then sends its queued messages and exits."""
        self._disconnect()
        offered, self._offered = self._offered, None
        if offered is not None:
            with contextlib.suppress(OSError):
                offered.close()
