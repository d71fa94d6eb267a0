"""Extend mkdocstrings to document record fields, enumeration members and command results.

mkdocstrings reads the sources without importing them. It therefore misses the fields that the
decorators `record` and `topic` in `softfinger.daemon.wire.fields` add to a record's docstring.
"""

from __future__ import annotations

import inspect
from enum import Enum
from importlib import import_module
from typing import Any

import griffe


class FieldDocs(griffe.Extension):
    """Extension that adds record fields and enumeration members to docstrings."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Complete the docstring of a record or enumeration."""
        decorators = {each.callable_path.rpartition(".")[2] for each in cls.decorators}
        is_record = not decorators.isdisjoint(("record", "topic"))
        is_enumeration = any(str(each) in ("IntEnum", "StrEnum") for each in cls.bases)
        if cls.docstring and (is_record or is_enumeration):
            found = getattr(import_module(cls.module.path), cls.name)
            cls.docstring.value = inspect.getdoc(found) or ""
            if is_enumeration:
                cls.docstring.value += _members(found)

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Replace the type variable for command results with None, the result in `Hand`."""
        if str(func.returns) == "_Done":
            func.returns = "None"


def _members(enumeration: type[Enum]) -> str:
    """Return a docstring section with all enumeration members that have a description."""
    meanings = {
        each.name: getattr(each, "meaning", "") or getattr(each, "text", "") for each in enumeration
    }
    rows = "".join(f"\n{name}\n    {text}" for name, text in meanings.items() if text)
    return f"\n\nAttributes\n----------{rows}" if rows else ""
