"""The socket pair between the loop and the gateway: packets both ways, and the loop's end of it.

Each packet is one message of a Unix socket that never blocks the loop. What goes out when there is
no room is dropped and counted, but for replies and fences, which wait for the next tick; the kernel
bounds what is on the way, and the gateway bounds what it sends to what the loop has answered.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

# From the loop. A message too long for one packet comes in pieces.
PUBLISH = b"P"  # topic's index, flags, piece of the message
REPLY = b"R"  # number, reply
FENCE = b"F"  # number: what came before this is not to be carried out
FIRST, LAST, KEEP = 1, 2, 4  # place of the piece; KEEP: sent again, after a restart

# From the gateway.
READY = b"U"  # nothing: the sockets are bound
FAILED = b"!"  # why they are not
PAST = b"T"  # number of a fence, time from when on what comes came after it
WANTED = b"W"  # topics that somebody subscribes to as bits, refused requests
ASK = b"C"  # when it came, number, request
NOTICE = b"N"  # a warning
STOP = b"S"  # as ASK: a stop, which goes before all else

NUMBER = struct.Struct("<I")
FENCE_PAST = struct.Struct("<Id")
WANTS = struct.Struct("<IQ")
ASKED = struct.Struct("<dI")

ALWAYS = math.inf  # when a request came that changes nothing, which no fence holds back

ANEW = 3  # exit status of a gateway that is to be started again, and has given the reason

LARGEST = 65_536  # bytes of a packet
_PIECE = 60_000
_ROOM = 1 << 20  # bytes that may be on the way; the kernel may allow less
_LOOK = 16  # packets taken in at a tick
_WAITING = 64  # replies and fences that wait for room
_NOTICES = 20
_PATIENCE = 2.0  # s for room on the way to a new gateway
_FENCES = 1 << 32  # that are told apart
_EVENTS = 50  # events that a gateway is given anew


@dataclass(frozen=True, slots=True)
class Topics:
    """The stream's topics, and which of them late subscribers get again."""

    names: tuple[str, ...]
    settings: int  # index of the one of which they get the last message
    events: int  # and of which the last few

    def matching(self, *prefixes: bytes) -> int:
        """Return the topics that begin with any of these, as bits."""
        names = enumerate(self.names)
        return sum(1 << k for k, name in names if name.encode().startswith(prefixes))


class Ask(NamedTuple):
    """A request that the gateway has checked. ``came`` is by `machine_time`, or `ALWAYS`."""

    came: float
    number: int
    packed: bytes


def machine_time() -> float:
    """Return monotonic time [s] that goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pair() -> tuple[socket.socket, socket.socket]:
    """Return both ends: the loop's and the gateway's."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM)
    return ends


def send_all(end: socket.socket, packets: list[bytes]) -> None:
    """Send packets, waiting for room: not for the loop. Raises OSError when there is none."""
    for packet in packets:
        if not select.select([], [end], [], _PATIENCE)[1]:
            raise TimeoutError("the gateway reads nothing")
        end.send(packet)


def pieces(topic: int, message: bytes) -> list[bytes]:
    """Return the packets that carry one message of the stream."""
    head = PUBLISH + bytes((topic,))
    count = max((len(message) + _PIECE - 1) // _PIECE, 1)
    return [
        head
        + bytes(((k == 0) * FIRST | (k == count - 1) * LAST,))
        + message[k * _PIECE : (k + 1) * _PIECE]
        for k in range(count)
    ]


class Link:
    """The loop's end. One thread, the loop's, may call it, but for `offer`."""

    def __init__(self) -> None:
        self.past = math.inf  # what came earlier came before the fence; infinite until that is read
        self.wanted = 0  # topics as bits
        self.refused = 0  # requests that the gateway refused because too many came
        self.lost = 0  # messages of the stream that found no room
        self.asked: deque[Ask] = deque()
        self.stops: deque[Ask] = deque()
        self.notices: deque[str] = deque(maxlen=_NOTICES)  # the gateway's warnings
        self.lasting: list[bytes] = []  # packets that every gateway is sent before it is offered
        self._fence = 0
        self._socket: socket.socket | None = None
        self._offered: socket.socket | None = None
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        self._last_events: deque[bytes] = deque(maxlen=_EVENTS)
        self.called = False  # something came at the descriptor of `watch`
        self._other = -1  # that descriptor
        self._poll = select.poll()

    def offer(self, end: socket.socket) -> None:
        """Use this from the next look on. From any thread."""
        self._offered = end

    def watch(self, descriptor: int) -> None:
        """Look at another descriptor, too: `called` is set when something waits there."""
        self._other = descriptor
        self._poll.register(descriptor, select.POLLIN)

    def look(self) -> None:
        """Take in the gateway's packets. Less than a microsecond when there are none."""
        if self._offered is not None:
            self._adopt()
        if self._waiting:
            self._send_waiting()
        ready = [descriptor for descriptor, _ in self._poll.poll(0)]
        self.called = self._other in ready
        if self._socket is None or self._socket.fileno() not in ready:
            return
        for _ in range(_LOOK):
            try:
                packet = self._socket.recv(LARGEST)
            except OSError:  # nothing more, or the gateway has died
                return
            if not packet:
                self._disconnect()
                return
            self._take(packet)

    def wait(self, seconds: float) -> None:
        """`look` when the gateway sends something, or after so long. Not for a tick."""
        self.look()
        sockets = [] if self._socket is None else [self._socket]
        select.select(sockets, [], [], seconds)
        self.look()

    def wait_for_room(self, seconds: float) -> None:
        """Wait until there is room for a message, for so long at most. Not for a tick."""
        self.look()
        if self._socket is not None:
            select.select([], [self._socket], [], seconds)

    def _take(self, packet: bytes) -> None:
        kind = packet[:1]
        if kind in (ASK, STOP):
            came, number = ASKED.unpack_from(packet, 1)
            ask = Ask(came, number, packet[1 + ASKED.size :])
            (self.stops if kind == STOP else self.asked).append(ask)
        elif kind == PAST:
            fence, past = FENCE_PAST.unpack_from(packet, 1)
            if fence == self._fence:
                self.past = past
        elif kind == NOTICE:
            self.notices.append(packet[1:].decode())
        elif kind == WANTED:
            self.wanted, self.refused = WANTS.unpack_from(packet, 1)

    def _adopt(self) -> None:
        """Use a new gateway's socket, and give it the last fence and the last events."""
        self._disconnect()
        self._socket, self._offered = self._offered, None
        assert self._socket is not None
        self._poll.register(self._socket, select.POLLIN)
        for packet in self._last_events:
            self._send(packet)
        if self._fence:
            self.raise_fence()
        else:
            self.past = -math.inf

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._poll.unregister(self._socket)
            self._socket.close()
            self._socket = None
        self.wanted = 0
        self.asked.clear()
        self.stops.clear()
        self._waiting.clear()

    def raise_fence(self) -> None:
        """Refuse all requests that arrived before this call, because the hand was stopped."""
        self._fence = (self._fence + 1) % _FENCES
        self.past = math.inf
        self._waiting.append(FENCE + NUMBER.pack(self._fence))
        self._send_waiting()

    def reply(self, number: int, reply: bytes) -> None:
        """Answer request ``number``."""
        self._waiting.append(REPLY + NUMBER.pack(number) + reply)
        self._send_waiting()

    def _send_waiting(self) -> None:
        while self._waiting and self._send(self._waiting[0]):
            self._waiting.popleft()

    def publish(self, topic: int, message: bytes, keep: bool = False) -> None:
        """One message of the stream; with ``keep`` a gateway started later is given it, too."""
        if len(message) > _PIECE:
            if not all(self._send(packet) for packet in pieces(topic, message)):
                self.lost += 1
            return
        packet = PUBLISH + bytes((topic, FIRST | LAST)) + message
        if keep:
            self._last_events.append(PUBLISH + bytes((topic, FIRST | LAST | KEEP)) + message)
        if not self._send(packet):
            self.lost += 1

    def publish_lasting(self, topic: int, message: bytes) -> None:
        """Publish what every subscriber gets, however late. Waits: not for a tick."""
        self.look()
        self.lasting = pieces(topic, message)
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a gateway that has died: the next is sent it
                send_all(self._socket, self.lasting)

    def _send(self, packet: bytes) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(packet)
        except OSError:  # no room, or the gateway has died
            return False
        return True

    def close(self) -> None:
        """Hang up; the gateway sends what it has and ends."""
        self._disconnect()
        offered, self._offered = self._offered, None
        if offered is not None:
            with contextlib.suppress(OSError):
                offered.close()
