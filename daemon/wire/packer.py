"""Messages as msgpack, packed as the schema says.

The two topics that may go out at every tick, `hand/state` and `hand/input`, are packed by one call
of `struct`: what stays from message to message, the keys and the few texts, is laid out once, until
a text changes. Their integers take 64 bits whatever their value.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import msgpack

from softfinger.daemon.wire.fields import KINDS, FieldSource, Getter, Topic, members
from softfinger.daemon.wire.schema import INPUT, STATE, TOPICS

pack = msgpack.Packer(use_bin_type=True).pack

_FALSE = 0xC2  # msgpack's byte; true is the next
_FORMS = {"bool": (b"", "B"), "int": (b"\xd3", "q"), "float": (b"\xcb", "d")}


def message_maker(topic: bytes) -> Callable[..., dict[str, Any]]:
    """Return the function that makes a topic's maps from its source's arguments."""
    source, make = TOPICS[topic].source, _maker(TOPICS[topic].record)
    return lambda *arguments: make(source(*arguments))


def _maker(record: type[Any]) -> Callable[[Any], dict[str, Any]]:
    """Return the function that makes a record's map from what it is taken from."""
    plan = [
        (
            each.name,
            _finder(each.source),
            each.get,
            None if each.type in KINDS else _maker(each.type),
        )
        for each in members(record)
    ]

    def make(given: Any) -> dict[str, Any]:
        made = {}
        for name, find, get, part in plan:
            value = get(find(given))
            made[name] = value if part is None else part(value)
        return made

    return make


def _finder(source: FieldSource[Any]) -> Getter:
    """Return the function that finds a source in the outermost one."""
    if source.outer is None:
        return source.get
    find, get = _finder(source.outer), source.get
    return lambda given: get(find(given))


def packer(topic: bytes) -> Callable[..., bytes]:
    """Return the function that packs a topic's messages from its source's arguments."""
    if topic in (STATE, INPUT):
        return _FixedLayout(TOPICS[topic]).pack
    make = message_maker(topic)
    return lambda *arguments: pack(make(*arguments))


class _FixedLayout:
    """Packs one topic's messages into the layout of the last one."""

    def __init__(self, topic: Topic) -> None:
        self._source = topic.source
        # Sources behind the first are each had from an earlier one, values each from one of them.
        self._sources: list[tuple[int, Getter]] = []
        self._text_of: list[tuple[int, Getter]] = []
        self._number_of: list[tuple[int, Getter]] = []
        self._flags: list[int] = []  # which numbers are truth values
        self._pieces: list[bytes | str] = []  # bytes that stay, and the kinds of fields
        self._enter(topic.record, 0)
        self._texts: list[str] | None = None
        self._struct = struct.Struct("")
        self._parts: list[bytes | float] = []  # alternately what stays, and a number

    def _enter(self, record: type[Any], at: int) -> None:
        """Enter a record's map, whose outermost source has the index ``at``."""
        found: dict[FieldSource[Any], int] = {}

        def index(source: FieldSource[Any]) -> int:
            if source.outer is None:
                return at
            if source not in found:
                found[source] = self._add_source(index(source.outer), source.get)
            return found[source]

        fields = list(members(record))
        self._pieces.append(msgpack.Packer().pack_map_header(len(fields)))
        for each in fields:
            self._pieces.append(msgpack.packb(each.name))
            source, kind = index(each.source), KINDS.get(each.type)
            if kind is None:
                self._enter(each.type, self._add_source(source, each.get))
                continue
            self._pieces.append(kind)
            if kind == "bool":
                self._flags.append(len(self._number_of))
            (self._text_of if kind == "str" else self._number_of).append((source, each.get))

    def _add_source(self, outer: int, get: Getter) -> int:
        self._sources.append((outer, get))
        return len(self._sources)

    def pack(self, *arguments: object) -> bytes:
        """Return the message made from the arguments of the topic's source."""
        sources = [self._source(*arguments)]
        for k, get in self._sources:
            sources.append(get(sources[k]))
        texts = [get(sources[k]) for k, get in self._text_of]
        if texts != self._texts:
            self._lay_out(texts)
        numbers = [get(sources[k]) for k, get in self._number_of]
        for k in self._flags:
            numbers[k] += _FALSE
        self._parts[1::2] = numbers
        return self._struct.pack(*self._parts)

    def _lay_out(self, texts: list[str]) -> None:
        """Find the bytes between the numbers."""
        form, fixed, left = ">", b"", iter(texts)
        self._parts = []
        for piece in self._pieces:
            if isinstance(piece, bytes):
                fixed += piece
            elif piece == "str":
                fixed += msgpack.packb(next(left))
            else:
                start, code = _FORMS[piece]
                fixed += start
                form += f"{len(fixed)}s{code}"
                self._parts += [fixed, 0]
                fixed = b""
        self._struct = struct.Struct(f"{form}{len(fixed)}s")  # behind the last number is no other
        self._parts.append(fixed)
        self._texts = texts
