"""The loop's side of commands: takes requests from the gateway, and has them carried out.

It runs in the loop's thread, once a tick, without a lock. A ``stop`` goes first; what came before
one is refused, wherever it waits (see `gateway.request_queue`), but for a ``status``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgpack

from softfinger.daemon.errors import Refused
from softfinger.daemon.wire.loop_link import ALWAYS, Link

if TYPE_CHECKING:  # the gateway has no use for it
    from softfinger.daemon.wire.local_stop import LocalStop

Handler = Callable[[dict[str, Any]], dict[str, Any]]

PASSED = "came while the daemon stood still or was starting, or before a stop; send it again"

_PAST_WITHIN = 0.1  # s that a local stop's answer waits for a gateway that may have died
_ARMING = 0.2  # s that torque on may take in the rest of a tick
_A_TICK = 2  # commands carried out at one, a stop not counted
_VALUES = (str, int, float)  # and bool, which is an int


class Pauses:
    """Notices a standstill: a process that was stopped or starved, a machine that slept."""

    def __init__(self, longest: float) -> None:
        """``longest`` [s] between two looks is no pause."""
        self._longest = longest
        self._looked = -math.inf

    def look(self, own_work: float = 0.0) -> bool:
        """Return whether there was one since the last look, or this is the first.

        ``own_work`` [s] may have been spent at work meanwhile.
        """
        now = time.clock_gettime(time.CLOCK_BOOTTIME)  # goes on while the machine sleeps
        paused = now - self._looked > self._longest + own_work
        self._looked = now
        return paused


class CommandServer:
    """Answers requests that come over a link, and a stop that comes past it."""

    def __init__(
        self, link: Link, local: LocalStop | None = None, longest_pause: float = math.inf
    ) -> None:
        """``longest_pause`` [s] between two calls of `serve` leaves what waits to be carried out.

        After a longer one it is refused: nobody who sent it knows any more what it would do.
        """
        self._link = link
        self.notices = link.notices  # the gateway's warnings, to be published as events
        self._local = local
        self._pauses = Pauses(longest_pause)
        self._worked = False  # a command that changes something was carried out at the last tick
        self._stopped: bytes | None = None  # answer to a local stop, until the gateway knows it
        self._answer_by = 0.0
        if local is not None:
            link.watch(local.fileno())

    @property
    def refused_by_pace(self) -> int:
        """Requests refused because too many came."""
        return self._link.refused

    def serve(self, handler: Handler) -> None:
        """Have ``handler`` carry out what is due at this tick.

        It raises Refused with the reason.
        """
        link = self._link
        self._notice_pause(_ARMING if self._worked else 0.0)
        self._worked = False
        link.look()
        if self._local is not None and (link.called or self._stopped is not None):
            self._serve_local(self._local, handler)
        while link.stops:
            stop = link.stops.popleft()
            reply = _carry_out(msgpack.unpackb(stop.packed), handler)
            link.raise_fence()  # before the answer, after which its client may go on
            link.reply(stop.number, reply)
        for _ in range(_A_TICK):
            self._notice_pause()  # it may have been since the link was looked at
            while link.asked and link.asked[0].came < link.past:
                link.reply(link.asked.popleft().number, _refusal(PASSED))
            if not link.asked:
                return
            ask = link.asked.popleft()
            reply = _carry_out(msgpack.unpackb(ask.packed), handler)
            self._pauses.look()  # to reconnect the servos may take long, and is no pause
            self._worked |= ask.came < ALWAYS
            link.reply(ask.number, reply)

    def start(self) -> None:
        """Refuse what has arrived until now, and be ready for what comes: waits, not for a tick."""
        self._pauses.look()
        self._link.look()
        self._link.raise_fence()
        ready_by = time.monotonic() + _PAST_WITHIN
        while self._link.past == math.inf and time.monotonic() < ready_by:
            self._link.wait(_PAST_WITHIN)

    def raise_fence(self) -> None:
        """Refuse what has arrived until now, but for a stop."""
        self._link.raise_fence()

    def _notice_pause(self, own_work: float = 0.0) -> None:
        if self._pauses.look(own_work):
            self._link.raise_fence()

    def _serve_local(self, local: LocalStop, handler: Handler) -> None:
        self._link.called = False
        if local.take():
            self._stopped = _carry_out({"command": "stop"}, handler)
            self._link.raise_fence()
            self._answer_by = time.monotonic() + _PAST_WITHIN
        if self._stopped is not None and (
            self._link.past < math.inf or time.monotonic() > self._answer_by
        ):
            local.answer(self._stopped)
            self._stopped = None


def _carry_out(request: dict[str, Any], handler: Handler) -> bytes:
    """The packed reply."""
    try:
        reply: bytes = msgpack.packb({"ok": True, **handler(request)})
    except Refused as refusal:
        return _refusal(str(refusal))
    return reply


def _refusal(error: str) -> bytes:
    packed: bytes = msgpack.packb({"ok": False, "error": error})
    return packed


def decode(payload: bytes) -> dict[str, Any]:
    """Unpack a command, a map of plain numbers and texts with a text under ``command``.

    Raises Refused for all else, but a stop is one whatever its map holds besides.
    """
    try:
        request = msgpack.unpackb(payload, raw=False, max_map_len=64, max_array_len=64)
    except Exception as error:  # msgpack raises many kinds, ValueError and its own among them
        raise Refused(f"not msgpack: {error}") from None
    if not isinstance(request, dict):
        raise Refused(f"expected a map, found {type(request).__name__}")
    if not isinstance(request.get("command"), str):
        raise Refused('expected a text under "command"')
    # Nothing nested: requests are published as they came.
    plain = {
        key: value
        for key, value in request.items()
        if isinstance(key, str) and (value is None or isinstance(value, _VALUES))
    }
    if len(plain) < len(request) and request["command"] != "stop":
        raise Refused("expected texts as keys, and numbers and texts as values")
    return plain
