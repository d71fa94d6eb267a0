"""Declarations of records of fields and of the stream's topics: the mechanism of `wire.schema`."""

import dataclasses
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar, cast, dataclass_transform

_Record = TypeVar("_Record")
_Value = TypeVar("_Value")
_From = TypeVar("_From")
_Within = TypeVar("_Within")

KINDS = {int: "int", float: "float", bool: "bool", str: "str", bytes: "bin"}
Getter = Callable[[Any], Any]


class Field(NamedTuple):
    """One number or text of a topic's map. A field of a map within the map has a dot in its name.

    ``kind`` is int, float, bool, str or bin; ``unit`` is empty where there is none.
    """

    name: str
    kind: str
    unit: str
    meaning: str


class Topic(NamedTuple):
    """One topic: the record of its messages, and the class of what a message is made from."""

    record: type[Any]
    summary: str
    source: Callable[..., Any]
    fields: tuple[Field, ...]


TOPICS: dict[bytes, Topic] = {}


class FieldSource(Generic[_From]):
    """Declares fields that are taken from a ``_From``, which ``get`` finds in ``outer``."""

    def __init__(
        self, outer: "FieldSource[Any] | None" = None, get: Getter = lambda it: it
    ) -> None:
        self.outer = outer
        self.get = get

    def of(self, get: Callable[[_From], _Within]) -> "FieldSource[_Within]":
        """Declare a source within this one."""
        return FieldSource(self, get)

    def __call__(
        self, unit: str, meaning: str, get: Callable[[_From], _Value] | None = None
    ) -> _Value:
        """Declare a field; without ``get`` it is the attribute of its own name."""
        about = {"unit": unit, "meaning": meaning, "source": self, "get": get}
        return cast(_Value, dataclasses.field(metadata=about))

    def part(self, prefix: str, get: Callable[[_From], object]) -> Any:
        """Declare a map within the map, whose own fields are taken from what ``get`` returns.

        ``prefix`` comes before all their meanings.
        """
        about = {"unit": "", "meaning": prefix, "source": self, "get": get}
        return dataclasses.field(metadata=about)


class Member(NamedTuple):
    """A record's field or part as it is declared."""

    name: str
    type: Any
    unit: str
    meaning: str  # a part's: what comes before those of its fields
    source: FieldSource[Any]
    get: Getter


def members(cls: type[Any]) -> Iterator[Member]:
    """Yield a record's fields and parts in their order."""
    for each in dataclasses.fields(cls):
        get = each.metadata["get"] or attrgetter(each.name)
        yield Member(each.name, each.type, **{**each.metadata, "get": get})


@dataclass_transform(frozen_default=True)
def record(cls: type[_Record]) -> type[_Record]:
    """Make a record of a class of declared fields."""
    return dataclasses.dataclass(frozen=True, slots=True)(cls)


def topic(
    name: bytes, summary: str, source: Callable[..., Any]
) -> Callable[[type[_Record]], type[_Record]]:
    """Declare that a record is a topic's, whose messages are each made from a ``source``."""

    def declare(cls: type[_Record]) -> type[_Record]:
        TOPICS[name] = Topic(cls, summary, source, tuple(fields_of(cls)))
        return cls

    return declare


def fields_of(cls: type[Any], outer: str = "", prefix: str = "") -> Iterator[Field]:
    """Yield all fields of a record in their order, those of records within it with a dot."""
    for each in members(cls):
        if each.type in KINDS:
            yield Field(outer + each.name, KINDS[each.type], each.unit, prefix + each.meaning)
        else:
            yield from fields_of(each.type, f"{outer}{each.name}.", each.meaning)
