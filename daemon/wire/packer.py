"""Messages as msgpack, packed as the schema says.

The integers of the two topics that may go out at every tick, `hand/state` and `hand/input`, take 64
bits whatever their value, so that a message keeps its length while its texts stay.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack

from softfinger.daemon.wire.fields import FieldSource, Getter, members
from softfinger.daemon.wire.schema import INPUT, STATE, TOPICS

Pack = Callable[[Any], bytes]

pack = msgpack.Packer(use_bin_type=True).pack
_float = partial(struct.Struct(">Bd").pack, 0xCB)
_bool = (b"\xc2", b"\xc3").__getitem__
_PACK: dict[type, Pack] = {int: pack, float: _float, bool: _bool, str: pack, bytes: pack}
_WIDE: dict[type, Pack] = _PACK | {int: partial(struct.Struct(">Bq").pack, 0xD3)}


def packer(topic: bytes) -> Callable[..., bytes]:
    """Return the function that packs a topic's messages from its source's arguments."""
    source = TOPICS[topic].source
    pack_map = _packer(TOPICS[topic].record, _WIDE if topic in (STATE, INPUT) else _PACK)
    return lambda *arguments: pack_map(source(*arguments))


def _packer(record: type[Any], kinds: dict[type, Pack]) -> Pack:
    """Return the function that packs a record's map from what it is taken from."""
    # Sources behind the first are each had from an earlier one, values each from one of them.
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
            kinds.get(each.type) or _packer(each.type, kinds),
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
