"""Messages of the stream as typed records, and lists of states as NumPy columns.

A message is data of unknown origin: a field that is missing or of another type is NaN, 0, False or
empty here, and unknown fields are ignored, so that a program goes on with the fields it knows when
the daemon's schema is newer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache, partial
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.wire.schema import HandState, fields_of

_Record = TypeVar("_Record")


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
