"""The schema for readers of the stream: the page ``STREAM.md``, and JSON Schema for recordings.

``python -m softfinger.daemon.wire.schema_docs`` writes the page anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softfinger.daemon.wire.schema import SCHEMA, TOPICS

_JSON: dict[str, dict[str, Any]] = {
    "int": {"type": "integer"},
    "float": {"type": ["number", "null"]},
    "bool": {"type": "boolean"},
    "str": {"type": "string"},
    "bin": {"type": "string", "contentEncoding": "base64"},
}

_INTRODUCTION = f"""\
# The stream

Written from `daemon/wire/schema.py` by `python -m softfinger.daemon.wire.schema_docs`;
a test keeps it true.

Schema {SCHEMA}. Two frames a message, topic and msgpack map with text keys, in SI units. Fields are
only ever added, none is left out, and none changes its type: a float is always sent as a float. A
field named `left.q` is `q` in the map `left`. The integers of `hand/state` and `hand/input` take 64
bits whatever their value.

`timestamp` is the machine's Unix time. `mono_ns` is the daemon's clock, for differences: the
machine's monotonic clock or, of a hand simulated in the daemon, one that waits while the machine is
too busy to keep up (`loop.clock`, `behind_s`). Durations (`tick_s`, `compute_s`, `hand/stats`) are
in the machine's time.
"""


def json_schema(topic: bytes) -> dict[str, Any]:
    """Return a topic's map as JSON Schema. Bytes are base64, a float that is no number null."""
    schema: dict[str, Any] = {
        "title": topic.decode(),
        "description": TOPICS[topic].summary,
        "type": "object",
        "properties": {},
    }
    for field in TOPICS[topic].fields:
        *outer, name = field.name.split(".")
        place = schema["properties"]
        for part in outer:
            place = place.setdefault(part, {"type": "object", "properties": {}})["properties"]
        unit = f" [{field.unit}]" if field.unit else ""
        place[name] = {**_JSON[field.kind], "description": field.meaning + unit}
    return schema


def page() -> str:
    """Return the page for people, in Markdown."""
    parts = [_INTRODUCTION]
    for name, topic in TOPICS.items():
        rows = [f"| `{f.name}` | {f.kind} | {f.unit} | {f.meaning} |" for f in topic.fields]
        table = "\n".join(["| field | type | unit | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## `{name.decode()}`\n\n{topic.summary}\n\n{table}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    Path(__file__).with_name("STREAM.md").write_text(page(), encoding="utf-8")
