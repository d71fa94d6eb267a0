"""What the clients for programs and for asyncio share: topics, subscriptions, gaps, schema."""

from __future__ import annotations

import logging
import warnings
from collections import deque
from typing import Any

import msgpack
import zmq

from softfinger.daemon.client.patience import still_waiting
from softfinger.daemon.client.records import read
from softfinger.daemon.wire import schema

_QUEUE = 100_000  # messages kept for a program that is slow for a while
_AGAIN = 1000  # messages that are known again
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB

_log = logging.getLogger(__name__)


def prepare(socket: Any, address: str, *topics: bytes) -> None:
    """Subscribe a SUB socket to topics. Raises zmq.ZMQError when the address can't be read."""
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVHWM, _QUEUE)
    socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
    for topic in topics:
        socket.setsockopt(zmq.SUBSCRIBE, topic)
    socket.connect(address)


def nothing_from(address: str, topic: bytes, seconds: float) -> str:
    """What a NoStream says."""
    return f"no {topic.decode()} from {address} within {seconds:g} s; is softfinger running?"


def silent(address: str, topic: bytes, seconds: float) -> None:
    """Log that nothing has come for a while."""
    _log.warning(still_waiting(f"{topic.decode()} from {address}", seconds))


class Gaps:
    """Counts what was lost between two messages of one topic.

    By their ``number`` where they have one, else by ``seq``, of which one in ``seq_step`` is sent.
    One that goes back is another daemon's, or the same one's started again: no loss. What is told
    ``again`` is news where it was not heard before, and may fill a gap.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last: dict[str, int] = {}
        self._heard: deque[int] = deque(maxlen=_AGAIN)  # of what may be told again

    def take(self, message: dict[str, Any]) -> bool:
        """Look at one more message. False: it was heard before."""
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
            if place in self._heard:
                return False
            self._heard.append(place)
            self.lost = max(self.lost - 1, 0)
            return True
        if again is not None:
            if last is not None and place <= last:
                self._heard.clear()  # another daemon's
            self._heard.append(place)
        if last is not None and place > last:
            self.lost += place - last - 1
        self._last[key] = place
        return True


class Decoder:
    """Turns what comes off the wire into records, counts gaps and tells a foreign schema once."""

    def __init__(self, topic: bytes) -> None:
        self._record = schema.TOPICS[topic].record
        self.gaps = Gaps()
        self.unreadable = 0
        self._told = False

    def take(self, frames: list[bytes]) -> Any | None:
        """The record of one message, None when it can't be read or was heard before."""
        try:
            message = msgpack.unpackb(frames[-1])
            if not isinstance(message, dict):
                raise ValueError("not a map")
            record = read(self._record, message)
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
            self.unreadable += 1
            return None
        if not self.gaps.take(message):
            return None
        found = message.get("schema")
        if found != schema.SCHEMA and not self._told:
            self._told = True
            warnings.warn(
                f"the stream is of schema {found!r}, this client knows {schema.SCHEMA}; "
                "it keeps to the fields it knows",
                stacklevel=3,
            )
        return record
