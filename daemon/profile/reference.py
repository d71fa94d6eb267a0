"""Generate the settings reference from the declared settings.

``python -m softfinger.daemon.profile.reference`` writes two files. ``config/sim.toml`` describes
every key and contains the values for the built-in simulated hand. ``config/schema.json`` is the
JSON schema for editors.
"""

from __future__ import annotations

import inspect
import json
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pydantic.json_schema import GenerateJsonSchema

import softfinger
from softfinger.daemon.profile.fields import Section
from softfinger.daemon.profile.settings import Settings

_WIDTH = 100  # maximum line length in sim.toml
_NO_BOUND = 1e9  # Bounds of this magnitude catch only mistyped values and are not shown.
_HEAD = """\
#:schema ./schema.json
# The built-in simulated hand, with every setting at its default. `softfinger run` without a profile
# starts this hand. Your own profile needs only the settings that differ. Units are SI unless stated
# otherwise; pairs are [left, right].
"""


class Key(NamedTuple):
    """One setting in the reference."""

    section: str
    name: str
    default: str  # in TOML syntax
    unit: str
    allowed: str  # bounds, or quoted names
    meaning: str

    def lines(self, prefix: str = "") -> Iterator[str]:
        """Yield the TOML lines of a setting: its meaning as a comment, then its default value."""
        yield from _comment(self.meaning)
        limits = ", ".join(filter(None, (self.unit, self.allowed)))
        yield f"{prefix}{self.name} = {self.default}{f' # {limits}' * bool(limits)}"


class _WithoutTitles(GenerateJsonSchema):
    """JSON schema generator that omits titles, because titles would only repeat the key names."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schema_text() -> str:
    """Return the JSON schema for profiles as a single line of text."""
    schema = {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "softfinger profile",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            name: section.model_json_schema(schema_generator=_WithoutTitles)
            for name, section in sections().items()
        },
    }
    return json.dumps(schema, ensure_ascii=False) + "\n"


def sections() -> dict[str, type[Section]]:
    """Return the section classes of a profile, keyed by name."""
    return {name: type(section) for name, section in Settings()}


def about(section: type[Section]) -> str:
    """Return the description of a section as Markdown."""
    return inspect.cleandoc(section.__doc__ or "").replace("``", "`")


def every_key() -> list[Key]:
    """Return all settings in the order of the profile."""
    return [
        Key(
            name,
            key,
            json.dumps(declared["default"], ensure_ascii=False),
            declared.get("unit", ""),
            _allowed(declared),
            declared["description"],
        )
        for name, section in sections().items()
        for key, declared in section.model_json_schema().get("properties", {}).items()
    ]


def profile() -> str:
    """Return the text of ``config/sim.toml``."""
    return _HEAD + "".join(f"\n{section_text(name)}" for name in sections())


def section_text(name: str) -> str:
    """Return a section's TOML text. Raises KeyError."""
    lines = [f"[{name}]", *_comment(about(sections()[name]))]
    for key in every_key():
        if key.section == name:
            lines += ["", *key.lines()]
    return "".join(f"{line}\n" for line in lines)


def _comment(text: str) -> Iterator[str]:
    for paragraph in text.split("\n\n"):
        yield from textwrap.wrap(
            " ".join(paragraph.split()), _WIDTH, initial_indent="# ", subsequent_indent="# "
        )


def _allowed(declared: dict[str, Any]) -> str:
    """Describe the values allowed for a key, or for each element of an array."""
    if "prefixItems" in declared:
        return _allowed(declared["prefixItems"][0])
    if "items" in declared:
        return _allowed(declared["items"])
    if "const" in declared:
        return json.dumps(declared["const"])
    if "enum" in declared:
        return ", ".join(map(json.dumps, declared["enum"]))
    if "examples" in declared:
        return ", ".join([*map(json.dumps, declared["examples"]), "or a plugin's name"])
    if declared["type"] == "boolean":
        return "true, false"
    whole = "integer" if declared["type"] == "integer" else ""
    return ", ".join(filter(None, (whole, _bounds(declared))))


def _bounds(declared: dict[str, Any]) -> str:
    low: float = declared.get("minimum", -_NO_BOUND)
    high: float = declared.get("maximum", _NO_BOUND)
    above: float | None = declared.get("exclusiveMinimum")
    if 0.0 < low <= 1.0 / _NO_BOUND:  # a positive quantity
        above = 0
    upper = high < _NO_BOUND
    if above is not None:
        return f"> {above:g}" + f", ≤ {high:.7g}" * upper
    if low > -_NO_BOUND:
        return f"{low:.7g} to {high:.7g}" if upper else f"≥ {low:g}"
    return f"≤ {high:.7g}" * upper


def main() -> None:
    """Write both files."""
    folder = Path(softfinger.__file__).parent / "config"
    (folder / "sim.toml").write_text(profile(), encoding="utf-8")
    (folder / "schema.json").write_text(schema_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
