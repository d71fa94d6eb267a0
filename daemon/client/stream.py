"""A topic's messages as records: decoding, lost messages, and waiting for a state.

A message is data of unknown origin: a field that is missing or of another type is NaN, 0, False or
empty here, and unknown fields are ignored, so that a program goes on with the fields it knows when
the daemon's schema is newer.
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

from softfinger.daemon.client.connection import SILENCE, still_waiting, subscribe, unpack
from softfinger.daemon.errors import HandClosed, HandFault, NoStream, NotInTime
from softfinger.daemon.wire.schema import SCHEMA, STATE, TOPICS, HandState, fields_of

_Record = TypeVar("_Record")

_REPEATED = 1000  # messages that are known when they are repeated

_log = logging.getLogger(__name__)


def read(record: type[_Record], message: object) -> _Record:
    """Return a topic's map as its record of `wire.schema`.

    Raises ValueError for a tactile frame that is no grid.
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
    """Return states as one array a field, nested ones with a dot (``left.force``), in their order.

    ``pandas.DataFrame(to_columns(states))`` takes it as it is. Records of another topic, too.
    """
    rows = list(states)
    names = [field.name for field in fields_of(type(rows[0]) if rows else HandState)]
    return {name: np.array([attrgetter(name)(row) for row in rows]) for name in names}


class Gaps:
    """Counts the messages of one topic that were lost.

    By their ``number`` where they have one, else by ``seq``, of which one in ``seq_step`` is sent.
    One that goes back is another daemon's, or the same one's started again: no loss. A repeated
    message (``again``) is new where it was not received before, and may fill a gap.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last: dict[str, int] = {}
        self._received: deque[int] = deque(maxlen=_REPEATED)

    def take(self, message: dict[str, Any]) -> bool:
        """Count one more message. False: it was received before."""
        place = message.get("number")
        if not isinstance(place, int):
            seq, step = message.get("seq"), message.get("seq_step", 1)
            if not isinstance(seq, int) or not isinstance(step, int) or step < 1:
                return True
            place = seq // step
        source, again = message.get("finger"), message.get("again")
        key = source if isinstance(source, str) else ""
        last = self._last.get(key)
        if again is True and last is not None and place <= last:
            if place in self._received:
                return False
            self._received.append(place)
            self.lost = max(self.lost - 1, 0)
            return True
        if again is not None:
            if last is not None and place <= last:
                self._received.clear()  # another daemon's
            self._received.append(place)
        if last is not None and place > last:
            self.lost += place - last - 1
        self._last[key] = place
        return True


def no_stream(address: str, topic: bytes, timeout: float) -> NoStream:
    """Return the exception when nothing has come at all."""
    return NoStream(
        f"no {topic.decode()} from {address} within {timeout:g} s; is softfinger running?"
    )


class Subscriber(Generic[_Record]):
    """A topic's socket and records: what `Subscription` and `AsyncSubscription` have in common.

    ``unreadable`` counts the messages that could not be read, and were left out.
    """

    def __init__(
        self, context: zmq.Context[Any], address: str, topic: bytes, timeout: float | None
    ) -> None:
        self._address = address
        self._topic = topic
        self._timeout = timeout
        self._record: type[_Record] = TOPICS[topic].record
        self._warned = False
        self._gaps = Gaps()
        self.unreadable = 0
        self._socket: Any = subscribe(context, address, topic)

    @property
    def lost(self) -> int:
        """Messages that never arrived, by the gaps in their ``seq``."""
        return self._gaps.lost

    def close(self) -> None:
        self._socket.close()

    def _require_open(self) -> None:
        if self._socket.closed:
            raise HandClosed("this subscription is closed: make another")

    def _take(self, frames: list[bytes]) -> _Record | None:
        """Return the record of one message, None when it can't be read or was received before."""
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
                f"the stream is of schema {found!r}, this client knows {SCHEMA}; "
                "it keeps to the fields it knows",
                stacklevel=3,
            )
        return record

    def _waits(self, timeout: float | None) -> Iterator[int | None]:
        """Yield how long to wait for the next message [ms], until ``timeout`` s are over.

        Log what is waited for when that takes long; without a timeout silence may be as it should.
        """
        if timeout is None:
            while True:
                self._require_open()
                yield None
        now = time.monotonic()
        end, warn_at = now + timeout, now + SILENCE
        while True:
            self._require_open()
            yield math.ceil(1e3 * (min(end, max(warn_at, now)) - now))
            now = time.monotonic()
            if now >= end:
                return
            if now >= warn_at:
                warn_at = math.inf
                _log.warning(still_waiting(f"{self._topic.decode()} from {self._address}", timeout))


class Wait:
    """A wait of ``timeout`` s for a state for which ``condition`` holds."""

    def __init__(self, condition: Callable[[HandState], object], timeout: float) -> None:
        self._condition = condition
        self._timeout = timeout
        self._end = time.monotonic() + timeout
        self._last: HandState | None = None

    def left(self) -> float:
        """Return how long the next state may take [s]. Raises NotInTime after the end."""
        left = self._end - time.monotonic()
        if left <= 0.0 and self._last is not None:
            raise self.over("")
        return max(left, 0.0)

    def ends_with(self, state: HandState) -> bool:
        """Return whether the condition holds. Raises HandFault for a hand in fault."""
        self._last = state
        if self._condition(state):
            return True
        if state.fault:
            raise HandFault(state.fault)
        return False

    def over(self, address: str) -> NotInTime | NoStream:
        """Return the exception when no further state came."""
        if self._last is None:
            return no_stream(address, STATE, self._timeout)
        return NotInTime(
            f"not within {self._timeout:g} s; the last state: mode {self._last.mode}, "
            f"tick {self._last.seq}"
        )
