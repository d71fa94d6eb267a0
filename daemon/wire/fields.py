"""Provide the functions and classes with which `wire.schema` declares topics and fields."""

import dataclasses
import inspect
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
    """One value in a topic's map. The name of a field in a nested map contains a dot.

    ``kind`` is int, float, bool, str or bin. ``unit`` is empty for a dimensionless field.
    """

    name: str
    kind: str
    unit: str
    meaning: str


class Topic(NamedTuple):
    """One topic with its record class and the source class from which messages are built."""

    record: type[Any]
    summary: str
    source: Callable[..., Any]
    fields: tuple[Field, ...]


TOPICS: dict[bytes, Topic] = {}


class FieldSource(Generic[_From]):
    """Object from which field values are read; ``get`` extracts it from the ``outer`` object."""

    def __init__(
        self, outer: "FieldSource[Any] | None" = None, get: Getter = lambda it: it
    ) -> None:
        self.outer = outer
        self.get = get

    def of(self, get: Callable[[_From], _Within]) -> "FieldSource[_Within]":
        """Declare the source that results from applying ``get`` to this source."""
        return FieldSource(self, get)

    def __call__(
        self, unit: str, meaning: str, get: Callable[[_From], _Value] | None = None
    ) -> _Value:
        """Declare a field.

        Without ``get``, the field value is the source attribute with the field's name.
        """
        about = {"unit": unit, "meaning": meaning, "source": self, "get": get}
        return cast(_Value, dataclasses.field(metadata=about))

    def part(self, prefix: str, get: Callable[[_From], object]) -> Any:
        """Declare a nested map; its fields are read from the object that ``get`` returns.

        ``prefix`` is prepended to the field descriptions.
        """
        return self("", prefix, get)


class Member(NamedTuple):
    """Field of a record, or nested map in a record."""

    name: str
    type: Any
    unit: str
    meaning: str  # for a nested map, the prefix of its field descriptions
    source: FieldSource[Any]
    get: Getter


def members(cls: type[Any]) -> Iterator[Member]:
    """Yield the fields and nested maps of a record in order."""
    for each in dataclasses.fields(cls):
        get = each.metadata["get"] or attrgetter(each.name)
        yield Member(each.name, each.type, **{**each.metadata, "get": get})


@dataclass_transform(frozen_default=True)
def record(cls: type[_Record]) -> type[_Record]:
    """Turn a class of declared fields into a record; list the fields in the class docstring."""
    made = dataclasses.dataclass(frozen=True, slots=True)(cls)
    listed = ["", "Attributes", "----------"]
    for each in members(made):
        unit = f" [{each.unit}]" if each.unit else ""
        meaning = each.meaning.removesuffix(": ") or each.type.__doc__.partition("\n")[0]
        listed += [f"{each.name} : {each.type.__name__}", f"    {meaning}{unit}"]
    made.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__ or ""), *listed])
    return made


@dataclass_transform(frozen_default=True)
def topic(
    name: bytes, summary: str, source: Callable[..., Any]
) -> Callable[[type[_Record]], type[_Record]]:
    """Turn a class into a topic's record; each message is built from an instance of ``source``."""

    def declare(cls: type[_Record]) -> type[_Record]:
        made = record(cls)
        TOPICS[name] = Topic(made, summary, source, tuple(fields_of(made)))
        return made

    return declare


def fields_of(cls: type[Any], outer: str = "", prefix: str = "") -> Iterator[Field]:
    """Yield all fields of a record in order, with dots in the names of nested fields."""
    for each in members(cls):
        if each.type in KINDS:
            yield Field(outer + each.name, KINDS[each.type], each.unit, prefix + each.meaning)
        else:
            yield from fields_of(each.type, f"{outer}{each.name}.", each.meaning)
