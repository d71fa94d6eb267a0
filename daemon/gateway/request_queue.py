"""Which request goes to the loop next, and which is refused: pace, fairness, and what a stop ends.

A ``stop`` goes first, whoever else sends, and one stop to the loop answers all that wait. Of all
else few are on their way to the loop at a time; the rest waits here, where every client has a place
and none more than its share. A client that sends more than it may a second is refused until it
pauses. Nothing here reads or sends.

Each request carries the epoch that its connection was in when it was read. The loop counts epochs
up, with every stop and whenever it could not act for a while, and carries out requests of the
present one alone; a connection comes into it only once nothing is left in it that arrived before.
A ``status`` changes nothing and is answered in any epoch.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import msgpack

from softfinger.daemon.errors import Refused
from softfinger.daemon.gateway import bounds
from softfinger.daemon.wire.command_server import PASSED, decode
from softfinger.daemon.wire.loop_link import ALWAYS

_NUMBERS = 1 << 30  # that requests are distinguished by
_FULL = "too many commands wait already"
_OLD = "waited too long for its turn; send it again"


class Client(Protocol):
    """Somebody who asks. ``pace`` counts what it sends."""

    alive: bool
    pace: Pace

    @property
    def name(self) -> str:
        """By its key; empty without."""

    @property
    def epoch(self) -> int:
        """Of which its connection is."""

    def answer(self, envelope: Any, reply: bytes) -> None:
        """Send the reply to one of its requests, unless it has gone."""


class Allowance:
    """So many a second, and a burst at once."""

    __slots__ = ("_left", "_then")

    def __init__(self, burst: float, now: float = 0.0) -> None:
        self._left = burst
        self._then = now

    def take(self, per_second: float, burst: float, now: float) -> bool:
        """Count one more; False when it is too many."""
        left = min(self._left + (now - self._then) * per_second, burst) - 1.0
        self._left = max(left, 0.0)
        self._then = now
        return left >= 0.0


class Pace(Allowance):
    """What a client may still send: so many a second, of which one second's worth at once."""

    __slots__ = ("behind", "refusals", "stopped")

    def __init__(self, per_second: float, now: float) -> None:
        super().__init__(per_second, now)
        self.behind = False  # it sent too much, and has not paused since
        self.begin_read()

    @property
    def tired(self) -> bool:
        """It sent too much at this read: it is not to be read for a while."""
        return self.stopped or self.refusals > 0

    def begin_read(self) -> None:
        """Some more of what it sent is going to be taken."""
        self.refusals = 0  # at this read
        self.stopped = False  # it sent a stop in a flood


class _Request(NamedTuple):
    envelope: Any
    epoch: int
    came: float
    packed: bytes


class RequestQueue:
    """The requests of all clients on their way to the loop, and the replies on their way back."""

    def __init__(
        self, max_bytes: int, per_second: float, forward: Callable[[bool, int, int, bytes], bool]
    ) -> None:
        """``forward`` gives the loop a request: whether it is a stop, epoch, number, packed map.

        It returns False when there is no room.
        """
        self._max_bytes = max_bytes
        self._per_second = per_second
        self._forward = forward
        self._number = 1
        self._waiting: dict[Client, deque[_Request]] = {}  # the next client's turn is first
        self._count = 0  # of them
        self._stops: list[tuple[Client, Any]] = []
        self._active: set[Client] = set()  # who has sent something in this second
        self._share_until = 0.0
        self._asked: dict[int, tuple[list[tuple[Client, Any]], float]] = {}
        self._late: dict[int, list[tuple[Client, Any]]] = {}  # the oldest first
        self._stop = 0  # the number of the stop that the loop has
        self.epoch = 0
        self.refused = 0  # because too many came

    def new_pace(self, now: float) -> Pace:
        """The pace of a new client."""
        return Pace(self._per_second, now)

    def take(self, client: Client, envelope: Any, payload: bytes, now: float) -> None:
        """One message of a client: it waits for its turn, or is refused."""
        pace, rate = client.pace, self._shared(client, now)
        pace.behind = not pace.take(rate, rate, now) or pace.behind
        if pace.behind and (pace.stopped or b"stop" not in payload):
            self._refuse_flood(client, envelope)
            return
        try:
            if len(payload) > self._max_bytes:
                raise Refused(f"message of {len(payload)} bytes; at most {self._max_bytes}")
            request = decode(payload)
        except Refused as refusal:
            _refuse(client, envelope, str(refusal))
            return
        if client.name:
            request["client"] = client.name
        if request["command"] == "stop":
            self._stops.append((client, envelope))
            pace.stopped = pace.behind
        elif pace.behind:
            self._refuse_flood(client, envelope)
        else:
            epoch = ALWAYS if request["command"] == "status" else client.epoch
            self._queue(client, _Request(envelope, epoch, now, msgpack.packb(request)))

    def _shared(self, client: Client, now: float) -> float:
        """What each client may send in a second: less when many send."""
        if now > self._share_until:
            self._share_until = now + 1.0
            self._active.clear()
        self._active.add(client)
        return min(self._per_second, max(bounds.ALL_RATE / len(self._active), bounds.LEAST_RATE))

    def _refuse_flood(self, client: Client, envelope: Any) -> None:
        self.refused += 1
        client.pace.refusals += 1
        if client.pace.refusals <= bounds.REFUSALS:
            _refuse(client, envelope, f"too many commands: at most {self._per_second:g} a second")

    def _queue(self, client: Client, request: _Request) -> None:
        queued = self._waiting.get(client)
        if queued is None:
            self._waiting[client] = queued = deque()
        elif len(queued) >= bounds.WAITING_EACH or self._count >= bounds.WAITING:
            self.refused += 1
            _refuse(client, request.envelope, _FULL)
            return
        queued.append(request)
        self._count += 1

    def pump(self, now: float) -> None:
        """Give the loop what it may have now."""
        while self._asked:
            number, (_, then) = next(iter(self._asked.items()))
            if now - then < bounds.LATE:
                break
            self._give_way(number)
        if self._stops and not self._stop:
            packed = msgpack.packb({"command": "stop", "client": self._stops[0][0].name})
            self._stop = self._ask(self._stops, self.epoch, packed, now, stop=True)
            if self._stop:
                self._stops = []
        while self._waiting and len(self._asked) < bounds.UNDER_WAY + bool(self._stop):
            client, queued = next(iter(self._waiting.items()))
            request = queued[0]
            if request.epoch not in (self.epoch, ALWAYS):
                _refuse(client, request.envelope, PASSED)
            elif now - request.came > bounds.OLDEST:
                _refuse(client, request.envelope, _OLD)
            elif client.alive:
                target = [(client, request.envelope)]
                if not self._ask(target, request.epoch, request.packed, now):
                    return
            queued.popleft()
            self._count -= 1
            del self._waiting[client]
            if queued:
                self._waiting[client] = queued  # behind all others

    def _ask(
        self,
        targets: list[tuple[Client, Any]],
        epoch: int,
        packed: bytes,
        now: float,
        stop: bool = False,
    ) -> int:
        """The number that the request was given; 0 when there was no room."""
        number = self._number
        if not self._forward(stop, epoch, number, packed):
            return 0
        self._number = number % _NUMBERS + 1
        self._asked[number] = (targets, now)
        return number

    def _give_way(self, number: int) -> None:
        """Let others have the place of a request that the loop is long about, or still starts."""
        if number == self._stop:
            self._stop = 0
        self._late[number], _ = self._asked.pop(number)
        if len(self._late) > bounds.LATE_ANSWERS:
            del self._late[next(iter(self._late))]

    def reply(self, number: int, reply: bytes) -> None:
        """The loop's answer to request ``number``."""
        if number in self._asked:
            self._give_way(number)
        for client, envelope in self._late.pop(number, ()):
            client.answer(envelope, reply)

    def begin_epoch(self, epoch: int) -> None:
        """What waits is refused at its turn; what is read from now on has its client's epoch."""
        self.epoch = epoch


def _refuse(client: Client, envelope: Any, error: str) -> None:
    client.answer(envelope, msgpack.packb({"ok": False, "error": error}))
