"""Pack stream messages according to the schema and send them to the gateway.

Integers use the shortest msgpack format, so that JavaScript clients receive plain numbers wherever
possible. Floats always take 64 bits.

The gateway serves the subscribers, so slow or disconnected subscribers do not affect the loop. For
late subscribers, the gateway repeats the settings and the last events with ``again`` set. Messages
of topics without subscribers are not packed.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack

from softfinger.daemon.types import HandInfo
from softfinger.daemon.wire.fields import FieldSource, Getter, members
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.schema import COMMAND, EVENT, SETTINGS, TOPICS

Pack = Callable[[Any], bytes]

pack = msgpack.Packer(use_bin_type=True).pack
_float = partial(struct.Struct(">Bd").pack, 0xCB)
_bool = (b"\xc2", b"\xc3").__getitem__
_PACK: dict[type, Pack] = {int: pack, float: _float, bool: _bool, str: pack, bytes: pack}


def packer(topic: bytes) -> Callable[..., bytes]:
    """Return a function that takes the arguments of a topic's source and packs a message."""
    source = TOPICS[topic].source
    pack_map = _packer(TOPICS[topic].record)
    return lambda *arguments: pack_map(source(*arguments))


def _packer(record: type[Any]) -> Pack:
    """Return a function that reads a record's fields from its source and packs them as a map."""
    # Each source after the first is derived from an earlier source. Each value is read from one
    # source.
    sources: list[tuple[int, Getter]] = []
    found: dict[FieldSource[Any], int] = {}

    def index(source: FieldSource[Any]) -> int:
        if source.outer is None:
            return 0
        if source not in found:
            sources.append((index(source.outer), source.get))
            found[source] = len(sources)
        return found[source]

    plan = [
        (
            pack(each.name),
            index(each.source),
            each.get,
            _PACK.get(each.type) or _packer(each.type),
        )
        for each in members(record)
    ]
    head = msgpack.Packer().pack_map_header(len(plan))

    def pack_map(given: Any) -> bytes:
        values = [given]
        for k, get in sources:
            values.append(get(values[k]))
        packed = [head]
        for key, k, get, put in plan:
            packed += key, put(get(values[k]))
        return b"".join(packed)

    return pack_map


_INDEX = {topic: index for index, topic in enumerate(TOPICS)}
GATEWAY_TOPICS = [topic.decode() for topic in TOPICS]
_REPEATED_COUNTS = {SETTINGS: 1, EVENT: 50}  # number of messages repeated to late subscribers


def bit(topic: bytes) -> int:
    """Return a topic's bit in `Publisher.wanted`."""
    return 1 << _INDEX[topic]


def publish(link: Link, topic: bytes, packed: bytes) -> None:
    """Publish a packed message."""
    link.publish(_INDEX[topic], packed, _REPEATED_COUNTS.get(topic, 0))


_COMMANDS = bit(COMMAND)


class Publisher:
    """Publisher of all stream topics. Only the loop's thread may call its methods."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._pack = {topic: packer(topic) for topic in TOPICS}
        self._numbers = {topic: itertools.count(1) for topic in (EVENT, COMMAND)}

    @property
    def wanted(self) -> int:
        """Bit mask of topics with subscribers; see `bit`."""
        return self._link.wanted

    def send(self, topic: bytes, *arguments: object) -> None:
        """Publish a message; ``arguments`` are passed to the topic's source in `wire.schema`."""
        publish(self._link, topic, self._pack[topic](*arguments))

    def event(self, wall: float, t: float, level: str, kind: str, text: str) -> None:
        """Publish ``hand/event``."""
        self.send(EVENT, next(self._numbers[EVENT]), wall, t, level, kind, text)

    def command(
        self, wall: float, t: float, tick: int, request: dict[str, Any], error: str
    ) -> None:
        """Publish ``hand/command``; ``error`` is the refusal text, or empty."""
        if self._link.wanted & _COMMANDS:
            self.send(COMMAND, next(self._numbers[COMMAND]), wall, t, tick, request, error)

    def settings(self, wall: float, t: float, info: HandInfo) -> None:
        """Publish ``hand/settings``, once."""
        self.send(SETTINGS, 1, wall, t, info)
