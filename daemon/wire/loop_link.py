"""Socket pair between the loop and the gateway: the messages, and the loop's end.

Each message is a msgpack list that begins with its kind. Sending never blocks: if the socket buffer
is full, the remaining bytes are sent later. Until then messages of the stream are dropped, but
replies and stops are not. The gateway limits the number of its unanswered requests.
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
PUBLISH = "publish"  # index of the topic, number of messages to repeat later, message
REPLY = "reply"  # `Ask.urgent` and `Ask.route` of the request, reply
FENCE = "fence"  # number of stops so far

# From the gateway
READY = "ready"  # the sockets are bound
FAILED = "failed"  # reason why the sockets could not be bound
ASK = "ask"  # the fields of `Ask`
REPORT = "report"  # `Link.wanted`, `Link.refused`, `Link.stops`
NOTICE = "notice"  # a warning

RESTART_STATUS = 3  # exit status of a gateway that must be restarted and has sent the reason

_BUFFER_SIZE = 1 << 20  # bytes of the socket buffer; the kernel may allow less
_CHUNK = 1 << 16  # bytes received at a time
_MESSAGE_SIZE_MAX = 64 << 20  # bytes of a message
_NOTICE_COUNT_MAX = 20
_FIRST, _AGAIN = (msgpack.packb("again") + msgpack.packb(again) for again in (False, True))


class Ask(NamedTuple):
    """A client's request that is within all limits but not unpacked yet.

    ``came`` is the arrival time by `machine_time`, and ``stops`` the number of stops that are known
    to have preceded it. An ``urgent`` request looks like a stop. ``name`` is the name of the client
    by its key. ``route`` is the route of the reply; its first part identifies the connection.
    """

    came: float
    stops: int
    urgent: bool
    name: str
    route: list[bytes]
    payload: bytes


def machine_time() -> float:
    """Return monotonic time [s], including the time that the machine is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pair() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a new socket pair: the loop's and the gateway's."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_SIZE)
    return ends


def repeated(message: bytes) -> bytes:
    """Return a stream message with its ``again`` field set, if it has one."""
    return message.replace(_FIRST, _AGAIN, 1)


class Channel:
    """One end of the socket pair, non-blocking."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._unsent = bytearray()
        self._unpacker = msgpack.Unpacker(max_buffer_size=_MESSAGE_SIZE_MAX)
        self.over = False  # the other end has disconnected

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, *message: object, droppable: bool = False) -> None:
        """Send a message, later if the buffer is full; a ``droppable`` message is then dropped."""
        if self._unsent and not self.flush() and droppable:
            return
        self._unsent += msgpack.packb(message)
        self.flush()

    def flush(self) -> bool:
        """Send unsent bytes; return True if all are sent."""
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
        """Yield the messages that arrived, from at most `_CHUNK` bytes per call."""
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
    """The loop's end. Only the loop's thread may call it, except `offer`."""

    def __init__(self) -> None:
        self.wanted = 0  # topics with subscribers, as bits
        self.refused = 0  # requests that the gateway refused because of their number
        self.stops = 0  # stops known to have preceded the requests that arrive now
        self.asked: deque[Ask] = deque()  # urgent requests first
        self.unpacked: deque[tuple[Ask, dict[str, Any]]] = deque()  # requests that wait for a tick
        self.notices: deque[str] = deque(maxlen=_NOTICE_COUNT_MAX)  # warnings of the gateway
        self.called = False  # the descriptor of `watch` is readable
        self._other = -1  # descriptor of `watch`
        self._fence = 0
        self._kept: dict[int, deque[bytes]] = {}  # for a restarted gateway, by topic
        self._channel: Channel | None = None
        self._offered: Channel | None = None
        self._poll = select.poll()

    def offer(self, channel: Channel) -> None:
        """Use this channel from the next `look` on. Any thread may call this."""
        self._offered = channel

    def watch(self, descriptor: int) -> None:
        """Also poll another descriptor; `called` is set when it is readable."""
        self._other = descriptor
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Read the messages of the gateway. It takes less than a microsecond if there are none."""
        has_more = self._offered is not None  # more messages may follow the first, read elsewhere
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
        """Call `look` when the gateway sends something, or after ``seconds``. Not for a tick."""
        self.look()
        channels = [] if self._channel is None else [self._channel]
        select.select(channels, [], [], seconds)
        self.look()

    def wait_for_room(self, seconds: float) -> None:
        """Wait until all bytes are sent. Not for a tick.

        Give up if the gateway does not read for ``seconds``.
        """
        self.look()
        if (channel := self._channel) is not None:
            while not channel.flush() and select.select([], [channel], [], seconds)[1]:
                pass

    def _adopt(self, channel: Channel) -> None:
        """Use the channel of a new gateway; send it the last fence and the stored messages."""
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
        """Tell the gateway the number of ``stops``, with which it stamps requests."""
        self._fence = stops
        if self._channel is not None and stops:
            self._channel.send(FENCE, stops)

    def reply(self, ask: Ask, reply: bytes) -> None:
        if self._channel is not None:
            self._channel.send(REPLY, ask.urgent, ask.route, reply)

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        """Publish a message; late subscribers also get the last ``keep`` messages of its topic."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(message)
        if self._channel is not None:
            self._channel.send(PUBLISH, topic, keep, message, droppable=True)

    def close(self) -> None:
        """Disconnect; the gateway sends its queued messages and ends."""
        self._disconnect()
        offered, self._offered = self._offered, None
        if offered is not None:
            with contextlib.suppress(OSError):
                offered.close()
