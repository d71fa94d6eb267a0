"""Messages as msgpack, packed by functions that are compiled from the schema.

The two topics that may go out at every tick, `hand/state` and `hand/input`, are packed by one call
of `struct`: what stays from message to message, the keys and the few texts, is laid out once, until
a text changes. Their integers take 64 bits whatever their value.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgpack

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.fields import Field, Topic
from softfinger.daemon.wire.schema import INPUT, NO_FRAME, SCHEMA, STATE, TOPICS

pack = msgpack.Packer(use_bin_type=True).pack

_FALSE = 0xC2  # msgpack's byte; true is the next
_FORMS = {"bool": (b"", "B"), "int": (b"\xd3", "q"), "float": (b"\xcb", "d")}

Tree = dict[str, Any]  # name → field, or another tree


def tree(fields: Iterable[Field]) -> Tree:
    """A topic's fields as its messages nest them."""
    root: Tree = {}
    for field in fields:
        *outer, name = field.name.split(".")
        place = root
        for part in outer:
            place = place.setdefault(part, {})
        place[name] = field
    return root


def message_maker(topic: bytes) -> Callable[..., dict[str, Any]]:
    """The function that makes a topic's maps from its arguments."""

    def display(place: Tree) -> str:
        parts = (
            f"{name!r}: {display(each) if isinstance(each, dict) else each.source}"
            for name, each in place.items()
        )
        return f"{{{', '.join(parts)}}}"

    return _compiled(TOPICS[topic], display(tree(TOPICS[topic].fields)))


def packer(topic: bytes) -> Callable[..., bytes]:
    """The function that packs a topic's messages from its arguments."""
    if topic in (STATE, INPUT):
        return _FixedLayout(TOPICS[topic]).pack
    make = message_maker(topic)
    return lambda *arguments: pack(make(*arguments))


def _compiled(topic: Topic, result: str) -> Callable[..., Any]:
    """A function of the topic's arguments that returns ``result``, an expression of sources."""
    lines = [f"def made({topic.arguments}):"]
    lines += [f"    {name} = {source}" for name, source in topic.names.items()]
    scope: dict[str, Callable[..., Any]] = {}
    known = {"SCHEMA": SCHEMA, "NO_FRAME": NO_FRAME, "FINGERS": FINGERS, "json": json}
    exec("\n".join([*lines, f"    return {result}"]), known, scope)
    return scope["made"]


class _FixedLayout:
    """Packs one topic's messages into the layout of the last one."""

    def __init__(self, topic: Topic) -> None:
        self._tree = tree(topic.fields)
        texts = [field.source for field in topic.fields if field.kind == "str"]
        numbers = [
            f"{_FALSE} + ({field.source})" if field.kind == "bool" else field.source
            for field in topic.fields
            if field.kind != "str"
        ]
        self._values = _compiled(topic, f"({', '.join(texts)},), ({', '.join(numbers)},)")
        self._texts: tuple[str, ...] | None = None
        self._struct = struct.Struct("")
        self._parts: list[bytes | float] = []  # alternately what stays, and a number

    def pack(self, *arguments: object) -> bytes:
        """The message made from a topic's arguments."""
        texts, numbers = self._values(*arguments)
        if texts != self._texts:
            self._lay_out(texts)
        self._parts[1::2] = numbers
        return self._struct.pack(*self._parts)

    def _lay_out(self, texts: tuple[str, ...]) -> None:
        """Find the bytes between the numbers."""
        form, fixed = ">", b""
        self._parts = []
        for part, code in self._pieces(self._tree, iter(texts)):
            fixed += part
            if code:
                form += f"{len(fixed)}s{code}"
                self._parts += [fixed, 0]
                fixed = b""
        self._struct = struct.Struct(f"{form}{len(fixed)}s")  # behind the last number is no other
        self._parts.append(fixed)
        self._texts = texts

    def _pieces(self, place: Tree, texts: Iterator[str]) -> Iterator[tuple[bytes, str]]:
        """Bytes that stay, each with the form of the number behind it, if there is one."""
        yield msgpack.Packer().pack_map_header(len(place)), ""
        for name, field in place.items():
            yield msgpack.packb(name), ""
            if isinstance(field, dict):
                yield from self._pieces(field, texts)
            elif field.kind == "str":
                yield msgpack.packb(next(texts)), ""
            else:
                yield _FORMS[field.kind]
