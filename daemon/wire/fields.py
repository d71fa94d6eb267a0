"""How a record of fields is declared, and a topic of the stream: the mechanism of `wire.schema`."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar, dataclass_transform

_Record = TypeVar("_Record")
_KINDS = {int: "int", float: "float", bool: "bool", str: "str", bytes: "bin"}


class Field(NamedTuple):
    """One number or text of a topic's map. A field of a map within the map has a dot in its name.

    ``kind`` is int, float, bool, str or bin; ``unit`` is empty where there is none; ``source`` is a
    Python expression over the topic's arguments.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    source: str


class Topic(NamedTuple):
    """One topic: the record of its messages, and what they are made from.

    ``arguments`` are those of the function that makes a message, ``names`` what its sources call
    parts of them.
    """

    record: type[Any]
    summary: str
    arguments: str
    names: dict[str, str]
    fields: tuple[Field, ...]


TOPICS: dict[bytes, Topic] = {}


def field(unit: str, meaning: str, source: str = "") -> Any:
    """Declare a field. By default its source is the one its part or topic has for all."""
    return dataclasses.field(metadata={"unit": unit, "meaning": meaning, "source": source})


def part(source: str, prefix: str = "", **places: object) -> Any:
    """Declare a map within the map.

    ``source`` is that of each field, with {name} for its name; ``places`` are filled into all
    sources, ``prefix`` comes before all meanings.
    """
    return dataclasses.field(metadata={"source": source, "prefix": prefix, "places": places})


@dataclass_transform(frozen_default=True, field_specifiers=(field, part))
def record(cls: type[_Record]) -> type[_Record]:
    """Make a record of a class of declared fields."""
    return dataclasses.dataclass(frozen=True, slots=True)(cls)


def topic(
    name: bytes, summary: str, arguments: str, source: str = "{name}", **names: str
) -> Callable[[type[_Record]], type[_Record]]:
    """Declare that a record is a topic's; ``source`` is each field's, with {name} for its name."""

    def declare(cls: type[_Record]) -> type[_Record]:
        fields = tuple(fields_of(cls, source))
        TOPICS[name] = Topic(cls, summary, arguments, names, fields)
        return cls

    return declare


def fields_of(
    cls: type[Any], source: str = "", outer: str = "", prefix: str = "", **places: Any
) -> Iterator[Field]:
    """All fields of a record in their order, those of records within it with a dot."""
    for each in dataclasses.fields(cls):
        name, given, kind = outer + each.name, each.metadata, each.type
        assert isinstance(kind, type)
        if kind in _KINDS:
            own = (given["source"] or source).format(name=each.name, **places)
            yield Field(name, _KINDS[kind], given["unit"], prefix + given["meaning"], own)
        else:
            within = fields_of(
                kind, given["source"], f"{name}.", given["prefix"], **given["places"]
            )
            yield from within
