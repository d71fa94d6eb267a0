"""The loop's side of commands: unpacks requests that the gateway passes on, and answers them.

It runs in the loop's thread, once a tick, without a lock. A ``stop`` goes first. What came before
one is refused, wherever it waited, but for a ``status``: its stamp counts fewer stops. A ``hold``
takes the place of the one that waits just before it.

A client may give a request a ``key`` that no other request has, and send the same map again when it
was refused as late. The command is then carried out once at most, and only if no other command was
carried out since that refusal: the newest command prevails. What can only make the hand safer
(`UNLEASED`) is carried out each time.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import msgpack

from softfinger.daemon.errors import Reason, Refused
from softfinger.daemon.types import UNLEASED
from softfinger.daemon.wire.loop_link import Ask, Link, machine_time

if TYPE_CHECKING:  # the gateway has no use for it
    from softfinger.daemon.wire.local_stop import LocalStop

Handler = Callable[[dict[str, Any], float], dict[str, Any]]  # request, its age [s]

_PAST_WITHIN = 0.4  # s that a local stop's answer waits for a gateway that may have died
_A_TICK = 2  # commands carried out at one, a stop not counted
_UNPACKED = 4096  # bytes after which no more requests are unpacked at a tick
_KEYS = 256  # requests whose outcome is kept
_KEY_LENGTH = 64
_VALUES = (str, int, float)  # and bool, which is an int


class _Outcome(NamedTuple):
    """Reply to a request that has a key."""

    stops: int  # number of stops when the request was first refused or carried out
    changes: int  # and of other commands carried out
    reply: bytes  # empty when the request was late, and may be sent again


class CommandServer:
    """Answers requests that come over a link, and a stop that comes past it."""

    def __init__(
        self,
        link: Link,
        local: LocalStop | None = None,
        clock: Callable[[], float] = machine_time,
    ) -> None:
        """``clock`` is the gateway's, by which it notes when a request came."""
        self._link = link
        self.notices = link.notices  # the gateway's warnings, to be published as events
        self._local = local
        self._clock = clock
        self._stops = 0
        self._changes = 0  # commands carried out that may change the hand, but for stops
        # By the key's client and the request, oldest first.
        self._outcomes: OrderedDict[tuple[str, bytes], _Outcome] = OrderedDict()
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
        self._link.look()
        if self._local is not None and (self._link.called or self._stopped is not None):
            self._serve_local(self._local, handler)
        self._unpack(handler)
        waiting, done = self._link.unpacked, 0
        while waiting and done < _A_TICK:
            ask, request = waiting.popleft()
            done += ask.stops == self._stops
            self._link.reply(ask, self._answer(ask, request, handler))

    def raise_fence(self) -> None:
        """Refuse all commands that arrived before now, except stop and status: the hand stopped."""
        self._stops += 1
        self._link.fence(self._stops)

    def _unpack(self, handler: Handler) -> None:
        """Take in what has come; carry out a stop, several at once as one."""
        stopped, waiting = b"", self._link.unpacked
        size = 0  # bytes
        while self._link.asked and size < _UNPACKED:
            ask = self._link.asked.popleft()
            size += len(ask.payload)
            try:
                request = decode(ask.payload)
                if ask.urgent and request["command"] != "stop":  # the map names two commands
                    raise _malformed('expected one text under "command"')
            except Refused as refused:
                self._link.reply(ask, refusal(str(refused), refused.reason))
                continue
            if ask.name:
                request["client"] = ask.name
            if request["command"] == "stop":
                if not stopped:
                    stopped = accepted(handler({"command": "stop", "client": ask.name}, 0.0))
                    self.raise_fence()  # before the answer, after which its client may go on
                self._link.reply(ask, stopped)
                continue
            mine = [other for other in waiting if other[0].route[0] == ask.route[0]]
            if mine and _replaces(request, mine[-1][1]):
                waiting.remove(mine[-1])
                text = "hold: a newer one of this connection replaced it"
                self._link.reply(mine[-1][0], refusal(text, Reason.SUPERSEDED))
            waiting.append((ask, request))

    def _answer(self, ask: Ask, request: dict[str, Any], handler: Handler) -> bytes:
        """Return the reply to a request; one that has a key is carried out once at most."""
        name, place = request["command"], (ask.name, ask.payload)
        keyed = request.pop("key", None) is not None and name not in UNLEASED
        present = _Outcome(self._stops, self._changes, b"")
        first = self._outcomes.pop(place, present) if keyed else present
        reply, late = first.reply, False
        if not reply:
            try:
                if first.stops != self._stops or (ask.stops != self._stops and name != "status"):
                    text = "not carried out: it came before a stop, or too soon after it"
                    raise Refused(text, Reason.STOPPED)
                if first.changes != self._changes:
                    text = f"{name}: another command was carried out since this one was late"
                    raise Refused(text, Reason.SUPERSEDED)
                reply = accepted(handler(request, self._clock() - ask.came))
                self._changes += name != "status"
            except Refused as refused:
                reply, late = refusal(str(refused), refused.reason), refused.reason == Reason.LATE
        if keyed:
            self._outcomes[place] = first._replace(reply=b"" if late else reply)
            if len(self._outcomes) > _KEYS:
                self._outcomes.popitem(last=False)
        return reply

    def _serve_local(self, local: LocalStop, handler: Handler) -> None:
        self._link.called = False
        if local.take():
            self._stopped = accepted(handler({"command": "stop"}, 0.0))
            self.raise_fence()
            self._answer_by = time.monotonic() + _PAST_WITHIN
        if self._stopped is not None and (
            self._link.stops == self._stops or time.monotonic() > self._answer_by
        ):
            local.answer(self._stopped)
            self._stopped = None


def _replaces(request: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return True if a hold sets all that another one before it does."""
    is_hold = request["command"] == other["command"] == "hold"
    return is_hold and other.keys() - {"key"} <= request.keys()


def accepted(reply: dict[str, Any]) -> bytes:
    """Return the packed reply to a command that is carried out."""
    packed: bytes = msgpack.packb({"ok": True, **reply})
    return packed


def refusal(error: str, reason: str) -> bytes:
    """Return the packed reply to a command that is not carried out."""
    packed: bytes = msgpack.packb({"ok": False, "error": error, "reason": str(reason)})
    return packed


def decode(payload: bytes) -> dict[str, Any]:
    """Unpack a command, a map of plain numbers and texts with a text under ``command``.

    Raises Refused for all else, but a stop is one whatever its map holds besides.
    """
    try:
        request = msgpack.unpackb(payload, raw=False, max_map_len=64, max_array_len=64)
    except Exception as error:  # msgpack raises many kinds, ValueError and its own among them
        raise _malformed(f"not msgpack: {error}") from None
    if not isinstance(request, dict):
        raise _malformed(f"expected a map, found {type(request).__name__}")
    if not isinstance(request.get("command"), str):
        raise _malformed('expected a text under "command"')
    # Nothing nested: requests are published as they came.
    plain = {
        key: value
        for key, value in request.items()
        if isinstance(key, str) and (value is None or isinstance(value, _VALUES))
    }
    if request["command"] == "stop":
        return plain
    if len(plain) < len(request):
        raise _malformed("expected texts as keys, and numbers and texts as values")
    key = plain.get("key", "-")
    if not isinstance(key, str) or not 0 < len(key) <= _KEY_LENGTH:
        raise _malformed(f"key: expected a text of 1 to {_KEY_LENGTH} characters")
    return plain


def _malformed(text: str) -> Refused:
    return Refused(text, Reason.REQUEST)
