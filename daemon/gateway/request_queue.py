"""Requests on their way to the loop, and refusals: pace, fairness, and the end by a stop.

A ``stop`` goes first, whoever else sends, and one stop to the loop answers all that wait. Of all
else few are on their way to the loop at a time; the rest waits here, where every client has a place
and none more than its share. A client that sends more than it may a second is refused until it
pauses. Nothing here reads or sends.

Each request carries the time at which it came, by which the loop judges its age. The loop raises a
fence with every stop. Requests that arrived before `RequestQueue.past` are refused; that is the
time by which everything sent before the fence had been read. A ``status`` changes nothing, and is
answered whenever it came. A ``hold`` takes the place of the one that waits just before it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import msgpack

from softfinger.daemon.errors import Reason, Refused
from softfinger.daemon.gateway import bounds
from softfinger.daemon.wire.command_server import decode, refusal, stopped
from softfinger.daemon.wire.loop_link import ALWAYS

Route = list[bytes]  # to a client: what ROUTER put before its request

_NUMBERS = 1 << 30  # that requests are distinguished by
_FULL = "too many commands wait already"
_SUPERSEDED = "hold: a newer one of this connection replaced it"


class Client:
    """Somebody who asks: so many requests a second, of which one second's worth at once."""

    __slots__ = ("_behind", "_left", "_then", "name", "stops")

    def __init__(self, name: str, per_second: float, now: float) -> None:
        """``name`` is by its key; empty without."""
        self.name = name
        self.stops = False  # a stop of its waits for the loop
        self._behind = False  # it sent too much, and has not paused since
        self._left = per_second
        self._then = now

    def floods(self, per_second: float, now: float) -> bool:
        """Count one more request; True when it is too many, or it has not paused since."""
        passed = now - self._then
        left = min(self._left + passed * per_second, per_second) - 1.0
        self._left = max(left, 0.0)
        self._then = now
        self._behind = left < 0.0 or (self._behind and passed < bounds.REST)
        return self._behind


class _Request(NamedTuple):
    route: Route
    came: float
    packed: bytes
    setpoints: frozenset[str]  # what a hold sets; empty for other commands


class RequestQueue:
    """The requests of all clients on their way to the loop, and the replies on their way back."""

    def __init__(
        self,
        max_bytes: int,
        per_second: float,
        forward: Callable[[bool, float, int, bytes], bool],
        answer: Callable[[Route, bytes], None],
    ) -> None:
        """``forward`` gives the loop a request: whether it is a stop, came, number, packed map.

        It returns False when there is no room. ``answer`` sends a reply.
        """
        self._max_bytes = max_bytes
        self._per_second = per_second
        self._forward = forward
        self._answer = answer
        self._number = 1
        self._waiting: dict[Client, deque[_Request]] = {}  # the next client's turn is first
        self._count = 0  # of them
        self._stops: list[tuple[Client, Route]] = []
        self._active: set[Client] = set()  # who has sent something in this second
        self._share_until = 0.0
        self._asked: dict[int, tuple[list[Route], float]] = {}
        self._late: dict[int, list[Route]] = {}  # the oldest first
        self._stop = 0  # the number of the stop that the loop has
        self.past = -math.inf
        self.refused = 0  # because too many came

    def new_client(self, name: str, now: float) -> Client:
        return Client(name, self._per_second, now)

    def take(self, client: Client, route: Route, payload: bytes, now: float, came: float) -> None:
        """One message of a client, read ``now``: it waits for its turn, or is refused.

        It came at ``came`` or later.
        """
        flood = client.floods(self._shared(client, now), now)
        if flood and (client.stops or b"stop" not in payload):
            self._refuse_flood(route)
            return
        try:
            if len(payload) > self._max_bytes:
                text = f"message of {len(payload)} bytes; at most {self._max_bytes}"
                raise Refused(text, Reason.REQUEST)
            request = decode(payload)
        except Refused as refused:
            self._refuse(route, refused)
            return
        if client.name:
            request["client"] = client.name
        if request["command"] == "stop":
            self._stops.append((client, route))
            client.stops = True
        elif flood:
            self._refuse_flood(route)
        else:
            name = request["command"]
            came = ALWAYS if name == "status" else came
            setpoints = frozenset(request) - {"key"} if name == "hold" else frozenset[str]()
            self._queue(client, _Request(route, came, msgpack.packb(request), setpoints))

    def _shared(self, client: Client, now: float) -> float:
        """Return what each client may send in a second: less when many send."""
        if now > self._share_until:
            self._share_until = now + 1.0
            self._active.clear()
        self._active.add(client)
        return min(self._per_second, max(bounds.ALL_RATE / len(self._active), bounds.LEAST_RATE))

    def _refuse(self, route: Route, refused: Refused) -> None:
        self._answer(route, refusal(refused))

    def _refuse_flood(self, route: Route) -> None:
        self.refused += 1
        text = f"too many commands: at most {self._per_second:g} a second"
        self._refuse(route, Refused(text, Reason.BUSY))

    def _queue(self, client: Client, request: _Request) -> None:
        queued = self._waiting.get(client)
        if queued is None:
            self._waiting[client] = queued = deque()
        elif queued[-1].setpoints and queued[-1].setpoints <= request.setpoints:
            self._refuse(queued.pop().route, Refused(_SUPERSEDED, Reason.SUPERSEDED))
            self._count -= 1
        elif len(queued) >= bounds.WAITING_EACH or self._count >= bounds.WAITING:
            self.refused += 1
            self._refuse(request.route, Refused(_FULL, Reason.BUSY))
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
            self._stop = self._ask([route for _, route in self._stops], now, packed, now, stop=True)
            if self._stop:
                for client, _ in self._stops:
                    client.stops = False
                self._stops = []
        while self._waiting and len(self._asked) < bounds.UNDER_WAY + bool(self._stop):
            client, queued = next(iter(self._waiting.items()))
            route, came, packed, _ = queued[0]
            if came < self.past:
                self._refuse(route, stopped())
            elif not self._ask([route], came, packed, now):
                return
            queued.popleft()
            self._count -= 1
            del self._waiting[client]
            if queued:
                self._waiting[client] = queued  # behind all others

    def _ask(
        self, routes: list[Route], came: float, packed: bytes, now: float, stop: bool = False
    ) -> int:
        """The number that the request was given; 0 when there was no room."""
        number = self._number
        if not self._forward(stop, came, number, packed):
            return 0
        self._number = number % _NUMBERS + 1
        self._asked[number] = (routes, now)
        return number

    def _give_way(self, number: int) -> None:
        """Let others have the place of a request that the loop is long about, or still starts."""
        if number == self._stop:
            self._stop = 0
        self._late[number], _ = self._asked.pop(number)
        if len(self._late) > bounds.LATE_ANSWERS:
            del self._late[next(iter(self._late))]

    def reply(self, number: int, reply: bytes) -> None:
        """Take the loop's answer to request ``number``."""
        if number in self._asked:
            self._give_way(number)
        for route in self._late.pop(number, ()):
            self._answer(route, reply)
