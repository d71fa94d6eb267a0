"""The socket pair between the loop and the gateway: messages both ways, and the loop's end of it.

Each message is a msgpack list that begins with its kind. Sending never waits: bytes that find no
room are sent later. Until then messages of the stream are dropped; replies and stops are not. The
gateway bounds the requests that it sends by the replies that it has received.
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
PUBLISH = "publish"  # topic's index, how many of its last messages late subscribers get, message
REPLY = "reply"  # urgent and route of the request, reply
FENCE = "fence"  # number of stops so far

# From the gateway
READY = "ready"  # the sockets are bound
FAILED = "failed"  # why they are not
ASK = "ask"  # the fields of `Ask`
REPORT = "report"  # `Link.wanted`, `Link.refused`, `Link.stops`
NOTICE = "notice"  # a warning

ANEW = 3  # exit status of a gateway that is to be started again, and has given the reason

_ROOM = 1 << 20  # bytes that may be on the way; the kernel may allow less
_CHUNK = 1 << 16  # bytes taken in at a time
_LARGEST = 64 << 20  # bytes of a message
_NOTICES = 20
_FIRST, _AGAIN = (msgpack.packb("again") + msgpack.packb(again) for again in (False, True))


class Ask(NamedTuple):
    """A client's request, within all bounds but not unpacked yet.

    ``came`` is by `machine_time`. ``stops`` is the number of stops that are known to have been
    carried out before the request came. An ``urgent`` one looks like a stop. ``name`` is the
    client's, by its key. ``route`` is where the reply goes; its first part names the connection.
    """

    came: float
    stops: int
    urgent: bool
    name: str
    route: list[bytes]
    payload: bytes


def machine_time() -> float:
    """Return monotonic time [s] that goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pair() -> tuple[socket.socket, socket.socket]:
    """Return both ends: the loop's and the gateway's."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM)
    return ends


def repeated(message: bytes) -> bytes:
    """Return a message of the stream marked as sent again, if its topic has such a mark."""
    return message.replace(_FIRST, _AGAIN, 1)


class Channel:
    """One end of the pair. Nothing here waits."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._unsent = bytearray()
        self._unpacker = msgpack.Unpacker(max_buffer_size=_LARGEST)
        self.over = False  # the other end has gone

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, *message: object, droppable: bool = False) -> None:
        """Send a message, later where there is no room; a ``droppable`` one then not at all."""
        if self._unsent and not self.flush() and droppable:
            return
        self._unsent += msgpack.packb(message)
        self.flush()

    def flush(self) -> bool:
        """Send bytes that wait for room; return True if none wait any more."""
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
        """Yield the messages that have come, a bounded number of bytes at a time."""
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
    """The loop's end. One thread, the loop's, may call it, but for `offer`."""

    def __init__(self) -> None:
        self.wanted = 0  # topics as bits
        self.refused = 0  # requests that the gateway refused because too many came
        self.stops = 0  # stops before which all that comes now cannot have come
        self.asked: deque[Ask] = deque()  # urgent ones first
        self.unpacked: deque[tuple[Ask, dict[str, Any]]] = deque()  # that wait for their tick
        self.notices: deque[str] = deque(maxlen=_NOTICES)  # the gateway's warnings
        self.called = False  # something came at the descriptor of `watch`
        self._other = -1  # that descriptor
        self._fence = 0
        self._kept: dict[int, deque[bytes]] = {}  # for a gateway that is started later, by topic
        self._channel: Channel | None = None
        self._offered: Channel | None = None
        self._poll = select.poll()

    def offer(self, channel: Channel) -> None:
        """Use this from the next look on. From any thread."""
        self._offered = channel

    def watch(self, descriptor: int) -> None:
        """Look at another descriptor, too: `called` is set when something waits there."""
        self._other = descriptor
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Take in the gateway's messages. Less than a microsecond when there are none."""
        has_more = self._offered is not None  # perhaps: its first message was read elsewhere
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
        """`look` when the gateway sends something, or after so long. Not for a tick."""
        self.look()
        channels = [] if self._channel is None else [self._channel]
        select.select(channels, [], [], seconds)
        self.look()

    def wait_for_room(self, seconds: float) -> None:
        """Wait until all is sent, unless the gateway takes nothing for so long. Not for a tick."""
        self.look()
        if (channel := self._channel) is not None:
            while not channel.flush() and select.select([], [channel], [], seconds)[1]:
                pass

    def _adopt(self, channel: Channel) -> None:
        """Use a new gateway's channel, and give it the last fence and the messages to repeat."""
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
        """Have requests stamped by whether they came after so many stops."""
        self._fence = stops
        if self._channel is not None and stops:
            self._channel.send(FENCE, stops)

    def reply(self, ask: Ask, reply: bytes) -> None:
        if self._channel is not None:
            self._channel.send(REPLY, ask.urgent, ask.route, reply)

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        """Publish a message; late subscribers get the last ``keep`` of its topic again."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(message)
        if self._channel is not None:
            self._channel.send(PUBLISH, topic, keep, message, droppable=True)

    def close(self) -> None:
        """Hang up; the gateway sends what it has and ends."""
        self._disconnect()
        offered, self._offered = self._offered, None
        if offered is not None:
            with contextlib.suppress(OSError):
                offered.close()
