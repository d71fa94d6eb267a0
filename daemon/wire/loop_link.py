"""Connect the loop and the gateway with a socket pair, and define their messages.

Each message is a msgpack list whose first element is the message kind. Sending never blocks. If the
socket buffer is full, the remaining bytes are sent later. While bytes remain, stream messages are
dropped, but replies and stops are queued. The gateway limits the number of pending requests, so the
queue of replies and stops is bounded. If a message that is kept for late subscribers was dropped,
the last messages of its topic are repeated later.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack

# From the loop
PUBLISH = "publish"  # topic index, number of messages to keep for late subscribers, message
REPLY = "reply"  # `Ask.urgent` and `Ask.route` of the request, and the reply
FENCE = "fence"  # number of stops so far

# From the gateway
ASK = "ask"  # the `Ask` fields
REPORT = "report"  # `Link.wanted`, `Link.refused`, `Link.confirmed`

_BUFFER_SIZE = 1 << 20  # requested socket buffer size [bytes]; the kernel may allow less
_CHUNK = 1 << 16  # maximum number of bytes per receive call
_MESSAGE_SIZE_MAX = 64 << 20  # maximum message size [bytes]
_NOTICE_COUNT_MAX = 20
_CLOCK = getattr(time, "CLOCK_BOOTTIME", None)  # Linux only
_FIRST, _AGAIN = (msgpack.packb("again") + msgpack.packb(again) for again in (False, True))


class Ask(NamedTuple):
    """Client request that has passed the gateway's limits but has not been unpacked yet.

    ``came`` is the arrival time according to `machine_time`. ``stops`` is the number of stops that
    are known to have arrived before the request. ``urgent`` is True if the packed request looks
    like a stop. ``name`` is the client name that belongs to the client's key. ``route`` is the
    return route of the reply; its first part identifies the connection.
    """

    came: float
    stops: int
    urgent: bool
    name: str
    route: list[bytes]
    payload: bytes


def machine_time() -> float:
    """Return the monotonic time [s].

    On Linux, the time includes periods in which the machine is suspended.
    """
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)


def pair() -> tuple[socket.socket, socket.socket]:
    """Create a socket pair; return the loop's end and the gateway's end."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_SIZE)
    return ends


def repeated(message: bytes) -> bytes:
    """Return a stream message with its ``again`` field, if any, set to true."""
    return message.replace(_FIRST, _AGAIN, 1)


class Channel:
    """Non-blocking end of the socket pair."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._unsent = bytearray()
        self._unpacker = msgpack.Unpacker(max_buffer_size=_MESSAGE_SIZE_MAX)
        self.over = False  # True once either end has been closed

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, *message: object, droppable: bool = False) -> bool:
        """Send a message. If the buffer is full, drop a ``droppable`` message; queue any other.

        Returns False if the message was dropped.
        """
        if self.over or not (self.flush() or not droppable):
            return False
        self._unsent += msgpack.packb(message)
        self.flush()
        return True

    def flush(self) -> bool:
        """Send queued bytes; return True if the queue is empty afterwards."""
        try:
            while self._unsent:
                del self._unsent[: self._end.send(self._unsent)]
        except BlockingIOError:
            return False
        except OSError:  # The other end is closed, but unread messages may remain.
            self._unsent.clear()
        return True

    def receive(self) -> Iterator[list[Any]]:
        """Yield received messages; read at most `_CHUNK` bytes per call."""
        try:
            chunk = self._end.recv(_CHUNK)
            self.over = not chunk
            self._unpacker.feed(chunk)
        except BlockingIOError:
            pass
        except OSError:
            self.over = True
        yield from self._unpacker

    def close(self) -> None:
        self.over = True
        self._end.close()


class Link:
    """The loop's end of the socket pair.

    Other threads may only call `offer`, append to `notices` and read `confirmed`.
    """

    def __init__(self) -> None:
        self.wanted = 0  # bit mask of topics with subscribers
        self.refused = 0  # number of requests refused by the gateway's rate and queue limits
        self.stops = 0  # number of stops so far
        self.confirmed = 0  # stop count with which the gateway, or the last one, stamps requests
        self.asked: deque[Ask] = deque()  # received requests, with urgent requests first
        self.unpacked: deque[tuple[Ask, dict[str, Any]]] = deque()  # queued for a later tick
        self.notices: deque[str] = deque(maxlen=_NOTICE_COUNT_MAX)  # gateway warnings
        # Last messages of each topic, which are repeated to a restarted gateway.
        self._kept: dict[int, deque[bytes]] = {}
        self._dropped: set[int] = set()  # topics whose kept messages must be repeated
        self._offered: Channel | None = None
        self._channel = Channel(socket.socket())  # replaced by `offer`
        self._channel.close()

    def offer(self, channel: Channel) -> None:
        """Switch to this channel at the next call to `look`. Any thread may call this method."""
        self._offered = channel

    def look(self) -> bool:
        """Read the gateway's messages; return True if no bytes for the gateway remain queued."""
        if self._offered is not None:
            self.close()
            self._channel, self._offered = self._offered, None
            self._dropped.update(self._kept)
            self._repeat()
            self._channel.send(FENCE, self.stops)
        channel = self._channel
        if channel.over:
            return True
        for kind, *fields in channel.receive():
            if kind == REPORT:
                self.wanted, self.refused, self.confirmed = fields
            else:
                ask = Ask(*fields)
                (self.asked.appendleft if ask.urgent else self.asked.append)(ask)
        if channel.over:
            self.close()
        if not channel.flush():
            return False
        self._repeat()
        return channel.flush()

    def _repeat(self) -> None:
        """Send the kept messages of the topics in `_dropped` again."""
        while self._dropped:
            kept = self._kept[topic := self._dropped.pop()]
            for message in kept:
                self._channel.send(PUBLISH, topic, kept.maxlen, repeated(message))

    def fence(self) -> None:
        """Refuse all requests that arrived before a stop, except ``stop`` and ``status``.

        The gateway receives the new stop count and stamps new requests with it.
        """
        self.stops += 1
        self._channel.send(FENCE, self.stops)

    def reply(self, ask: Ask, reply: bytes) -> None:
        self._channel.send(REPLY, ask.urgent, ask.route, reply)

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        """Publish a message. Late subscribers receive the last ``keep`` messages of the topic."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(message)
        if not self._channel.send(PUBLISH, topic, keep, message, droppable=True) and keep:
            self._dropped.add(topic)

    def close(self) -> None:
        """Disconnect. The gateway then sends its queued messages and exits."""
        self._channel.close()
        self.wanted = 0
        self.asked.clear()
        self.unpacked.clear()
