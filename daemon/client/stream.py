"""Decode stream messages into records, count lost messages, and wait for states.

Messages are untrusted input. A missing field, or a field of the wrong type, becomes NaN, 0, False
or an empty value. Unknown fields are ignored, so a program still works if the daemon uses a newer
schema.
"""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from functools import cache, partial
from operator import attrgetter
from typing import Any, Generic, TypeVar

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.connection import (
    SILENCE_TIME,
    OneThread,
    milliseconds,
    still_waiting,
    subscribe,
    unpack,
)
from softfinger.daemon.errors import HandClosed, HandFault, NoStream, NotInTime
from softfinger.daemon.wire.schema import SCHEMA, STATE, TOPICS, HandState, fields_of

_Record = TypeVar("_Record")

_STORED_MESSAGE_COUNT = 1000  # number of message numbers stored to detect repetitions

_log = logging.getLogger(__name__)


def read(record: type[_Record], message: object) -> _Record:
    """Convert a decoded message to a record from `wire.schema`.

    Raises ValueError if the data size of a tactile frame does not match its grid.
    """
    given = message if isinstance(message, dict) else {}
    plan = _converters(record)  # type: ignore[arg-type]  # a class is hashable
    return record(*(convert(given.get(name)) for name, convert in plan))


@cache
def _converters(record: Any) -> list[tuple[str, Callable[[object], Any]]]:
    kinds: list[tuple[str, Any]] = [(each.name, each.type) for each in fields(record)]
    return [(name, _CONVERTERS.get(kind) or partial(read, kind)) for name, kind in kinds]


def _as_float(value: object) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number else math.nan  # type: ignore[arg-type]


_CONVERTERS: dict[Any, Callable[[object], Any]] = {
    float: _as_float,
    int: lambda value: value if type(value) is int else 0,
    str: lambda value: value if isinstance(value, str) else "",
    bool: lambda value: value is True,
    bytes: lambda value: value if isinstance(value, bytes) else b"",
}


def to_columns(states: Iterable[Any]) -> dict[str, NDArray[Any]]:
    """Convert states to one array per field; nested fields have names such as ``left.force``.

    The result can be passed to ``pandas.DataFrame``. The function also converts records of other
    topics.
    """
    rows = list(states)
    names = [field.name for field in fields_of(type(rows[0]) if rows else HandState)]
    return {name: np.array([attrgetter(name)(row) for row in rows]) for name in names}


class Gaps:
    """Counter for lost messages on one topic.

    A message is identified by its ``number``. A message without ``number`` is identified by ``seq``
    divided by ``seq_step``. If the number decreases, no loss is counted, because either the daemon
    has restarted or a second daemon is running. If a copy marked ``again`` replaces a lost message,
    the count decreases by 1. A copy with the number of a received message is a repetition if both
    have the same time. Otherwise, the copy comes from a restarted daemon.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last: dict[str, int] = {}
        # Numbers and times of the last messages.
        self._received: deque[tuple[int, int]] = deque(maxlen=_STORED_MESSAGE_COUNT)

    def take(self, message: dict[str, Any]) -> bool:
        """Count one message; return False if the message is a repetition."""
        place = message.get("number")
        if not isinstance(place, int):
            seq, step = message.get("seq"), message.get("seq_step", 1)
            if not isinstance(seq, int) or not isinstance(step, int) or step < 1:
                return True
            place = seq // step
        finger, again = str(message.get("finger")), message.get("again")
        last = self._last.get(finger, place - 1)
        is_older = place <= last
        time_ns = message.get("mono_ns")
        received = place, time_ns if isinstance(time_ns, int) else 0
        if again is True and is_older:
            if received in self._received:
                return False
            if all(place != number for number, _ in self._received):
                self._received.append(received)
                self.lost = max(self.lost - 1, 0)
                return True
        if again is not None:
            if is_older:
                self._received.clear()  # The stored messages come from another daemon.
            self._received.append(received)
        if not is_older:
            self.lost += place - last - 1
        self._last[finger] = place
        return True


def no_stream(address: str, topic: bytes, timeout: float) -> NoStream:
    """Return the exception to raise if no message arrives on a topic."""
    return NoStream(
        f"no {topic.decode()} from {address} within {timeout:g} s; is softfinger running?"
    )


class Subscriber(Generic[_Record]):
    """Socket and decoder for one topic; base class of `Subscription` and `AsyncSubscription`.

    ``unreadable`` counts the messages that were skipped because they could not be decoded.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        address: str,
        topic: bytes,
        timeout: float | None,
        thread: OneThread,
    ) -> None:
        self._thread = thread
        self._address = address
        self._topic = topic
        self._timeout = timeout
        self._record: type[_Record] = TOPICS[topic].record
        self._warned = False
        self._gaps = Gaps()
        self.unreadable = 0
        self._socket: Any = subscribe(context, address, topic)

    def __repr__(self) -> str:
        ended = ", closed" if self._socket.closed else ""
        where = f"{self._topic.decode()} from {self._address}"
        return f"{type(self).__name__}: {where}, {self.lost} lost{ended}"

    @property
    def lost(self) -> int:
        """Number of lost messages, computed from gaps in the sequence numbers."""
        return self._gaps.lost

    def close(self) -> None:
        """End the subscription."""
        self._thread.claim()
        self._socket.close()

    def _require_open(self) -> None:
        self._thread.claim()
        if self._socket.closed:
            raise HandClosed("this subscription is closed: create a new one")

    def _take(self, frames: list[bytes]) -> _Record | None:
        """Decode a message; return None if the message is unreadable or repeated."""
        try:
            _, message = unpack(frames)
            record = read(self._record, message)
        except ValueError:
            self.unreadable += 1
            return None
        if not self._gaps.take(message):
            return None
        found = message.get("schema")
        if found != SCHEMA and not self._warned:
            self._warned = True
            warnings.warn(
                f"the stream uses schema {found!r}, but this client supports schema {SCHEMA}; "
                "unknown fields are ignored",
                stacklevel=3,
            )
        return record

    def _waits(self, timeout: float | None) -> Iterator[int | None]:
        """Yield the duration [ms] of each wait until ``timeout`` [s] has expired.

        If ``timeout`` is a number, log a warning after 1 s.
        """
        if timeout is None:
            while True:
                self._require_open()
                yield None
        now = time.monotonic()
        end, warn_at = now + timeout, now + SILENCE_TIME
        while True:
            self._require_open()
            yield milliseconds(min(end, max(warn_at, now)) - now)
            now = time.monotonic()
            if now >= end:
                return
            if now >= warn_at:
                warn_at = math.inf
                _log.warning(still_waiting(f"{self._topic.decode()} from {self._address}", timeout))


class Wait:
    """Wait up to ``timeout`` [s] for a state that satisfies ``condition``."""

    def __init__(
        self, condition: Callable[[HandState], object], timeout: float, now: Callable[[], float]
    ) -> None:
        self._condition = condition
        self._timeout = timeout
        self._now = now
        self._end = now() + timeout
        self._last: HandState | None = None

    def left(self) -> float:
        """Return the remaining time [s].

        Raises NotInTime if no time remains and at least one state has arrived.
        """
        left = self._end - self._now()
        if left <= 0.0 and self._last is not None:
            raise self.over("")
        return max(left, 0.0)

    def ends_with(self, state: HandState) -> bool:
        """Return True if the condition is met.

        Raises HandFault if the condition is not met and the hand has a latched fault.
        """
        self._last = state
        if self._condition(state):
            return True
        if state.fault:
            raise HandFault(state.fault)
        return False

    def over(self, address: str) -> NotInTime | NoStream:
        """Return the exception to raise after a timeout."""
        if self._last is None:
            return no_stream(address, STATE, self._timeout)
        return NotInTime(
            f"condition not met within {self._timeout:g} s; last state: mode {self._last.mode}, "
            f"tick {self._last.seq}"
        )
