"""Unpack and answer the requests that the gateway forwards to the loop.

The command server runs in the loop's thread, once per tick, without a lock. A ``stop`` is executed
before all other requests. The gateway stamps each request with the number of stops that preceded
the request. If this number is lower than the current number of stops, the daemon refuses every
request except ``status``. A ``hold`` replaces a queued ``hold`` that directly precedes it on the
same connection.

A client may add a unique ``key`` to a request. If the request is refused as late, the client may
repeat it. The daemon executes a command with a key at most once, as long as it is one of the last
`_OUTCOME_COUNT_MAX` commands with a key. To protect newer commands, the daemon refuses a repetition
if it has executed another command in the meantime. The commands in `NO_LEASE_COMMANDS` can only
make the hand safer and are executed every time.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import msgpack

from softfinger.daemon.errors import Reason, Refused
from softfinger.daemon.types import NO_LEASE_COMMANDS
from softfinger.daemon.wire.local_stop import LocalStop
from softfinger.daemon.wire.loop_link import Ask, Link, machine_time

Handler = Callable[[dict[str, Any], float], dict[str, Any]]  # arguments: request and its age [s]

_ANSWER_TIMEOUT = 0.4  # maximum time to wait for the gateway before confirming a local stop [s]
_COMMANDS_PER_TICK = 2  # maximum number of commands per tick, not counting stops
_UNPACKED_SIZE_MAX = 4096  # After this number of bytes, unpacking pauses until the next tick.
_OUTCOME_COUNT_MAX = 256  # maximum number of stored outcomes
_KEY_LENGTH_MAX = 64
_VALUE_TYPES = (str, int, float, type(None))  # bool is a subclass of int


class CommandServer:
    """Server for requests from the gateway and for stops from the local socket."""

    def __init__(
        self,
        link: Link,
        local: LocalStop | None = None,
        clock: Callable[[], float] = machine_time,
    ) -> None:
        """Create a server; ``clock`` must be the clock that the gateway uses for time stamps."""
        self.link = link
        self._local = local
        self._clock = clock
        self._changes = 0  # number of executed commands other than status and stop
        # Outcomes of requests with a key, oldest first. The dictionary keys consist of the client
        # name and the packed request. The outcome is the reply. For a late request, the outcome is
        # the pair of stop count and change count at the first attempt.
        self._outcomes: OrderedDict[tuple[str, bytes], bytes | tuple[int, int]] = OrderedDict()
        self._stopped = b""  # reply to the last local stop
        self._answer_by = 0.0  # deadline for the gateway's confirmation

    def serve(self, handler: Handler) -> None:
        """Pass this tick's requests to ``handler`` and send its replies.

        The handler raises Refused to reject a command.
        """
        self.link.look()
        if self._local is not None:
            if self._local.take():
                self._stopped = self._stop(handler, "")
                self._answer_by = time.monotonic() + _ANSWER_TIMEOUT
            if self.link.confirmed == self.link.stops or time.monotonic() > self._answer_by:
                self._local.answer(self._stopped)
        self._unpack(handler)
        waiting, done = self.link.unpacked, 0
        while waiting and done < _COMMANDS_PER_TICK:
            ask, request = waiting.popleft()
            done += ask.stops == self.link.stops
            self.link.reply(ask, self._answer(ask, request, handler))

    def _stop(self, handler: Handler, client: str) -> bytes:
        reply = accepted(handler({"command": "stop", "client": client}, 0.0))
        self.link.fence()  # The client may act on the reply at once, so count the stop first.
        return reply

    def _unpack(self, handler: Handler) -> None:
        """Unpack all received requests. Execute a stop immediately, but only once per call."""
        stopped, waiting = b"", self.link.unpacked
        size = 0  # bytes
        while self.link.asked and size < _UNPACKED_SIZE_MAX:
            ask = self.link.asked.popleft()
            size += len(ask.payload)
            try:
                request = decode(ask.payload)
                if ask.urgent and request["command"] != "stop":  # The key "command" occurs twice.
                    raise _malformed('expected exactly one string under the key "command"')
            except Refused as refused:
                self.link.reply(ask, refusal(str(refused), refused.reason))
                continue
            if request["command"] == "stop":
                stopped = stopped or self._stop(handler, ask.name)
                self.link.reply(ask, stopped)
                continue
            if ask.name:
                request["client"] = ask.name
            mine = [other for other in waiting if other[0].route[0] == ask.route[0]]
            if mine and _replaces(request, mine[-1][1]):
                waiting.remove(mine[-1])
                text = "hold: replaced by a newer hold from the same connection"
                self.link.reply(mine[-1][0], refusal(text, Reason.SUPERSEDED))
            waiting.append((ask, request))

    def _answer(self, ask: Ask, request: dict[str, Any], handler: Handler) -> bytes:
        """Execute a request (at most once if the request has a key) and return the reply."""
        name, place = request["command"], (ask.name, ask.payload)
        keyed = request.pop("key", None) is not None and name not in NO_LEASE_COMMANDS
        counts = stops, changes = self.link.stops, self._changes
        first = self._outcomes.pop(place, counts) if keyed else counts
        reply = outcome = first
        if not isinstance(reply, bytes):
            try:
                if first[0] != stops or (ask.stops != stops and name != "status"):
                    text = "rejected: received before the last stop, or too soon after it"
                    raise Refused(text, Reason.STOPPED)
                if first[1] != changes:
                    text = f"{name}: another command was carried out after the first attempt"
                    raise Refused(text, Reason.SUPERSEDED)
                reply = outcome = accepted(handler(request, self._clock() - ask.came))
                self._changes += name != "status"
            except Refused as refused:
                reply = refusal(str(refused), refused.reason)
                outcome = first if refused.reason == Reason.LATE else reply
        if keyed:
            self._outcomes[place] = outcome
            if len(self._outcomes) > _OUTCOME_COUNT_MAX:
                self._outcomes.popitem(last=False)
        return reply


def _replaces(request: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return True if both are ``hold`` requests and ``request`` sets all values in ``other``."""
    is_hold = request["command"] == other["command"] == "hold"
    return is_hold and other.keys() - {"key"} <= request.keys()


def accepted(reply: dict[str, Any]) -> bytes:
    """Return the packed reply to a command that was executed."""
    packed: bytes = msgpack.packb({"ok": True, **reply})
    return packed


def refusal(error: str, reason: str) -> bytes:
    """Return the packed reply to a command that was refused."""
    packed: bytes = msgpack.packb({"ok": False, "error": error, "reason": str(reason)})
    return packed


def decode(payload: bytes) -> dict[str, Any]:
    """Unpack a command, which is a flat map of numbers and strings.

    Raises Refused for other data, or if the value of ``command`` is not a string. Additional fields
    in a `stop` command are ignored.
    """
    try:
        request = msgpack.unpackb(payload, raw=False, max_map_len=64, max_array_len=64)
    except msgpack.StackError:
        raise _malformed("not valid msgpack: nested too deeply") from None
    except Exception as error:  # The exceptions of msgpack have no common base class.
        raise _malformed(f"not valid msgpack: {str(error) or 'invalid format'}") from None
    if not isinstance(request, dict):
        raise _malformed(f"expected a map, found {type(request).__name__}")
    if not isinstance(request.get("command"), str):
        raise _malformed('expected a string under the key "command"')
    if request["command"] == "stop":
        return {"command": "stop"}
    # Requests are published unchanged, so nested values are rejected.
    if not all(isinstance(k, str) and isinstance(v, _VALUE_TYPES) for k, v in request.items()):
        raise _malformed("expected strings as keys, and numbers or strings as values")
    key = request.get("key", "-")
    if not isinstance(key, str) or not 0 < len(key) <= _KEY_LENGTH_MAX:
        raise _malformed(f"key: expected a string of 1 to {_KEY_LENGTH_MAX} characters")
    return request


def _malformed(text: str) -> Refused:
    return Refused(text, Reason.REQUEST)
