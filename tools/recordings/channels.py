"""Convert a topic's message maps to a channel's JSON, and back."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from functools import partial
from typing import Any

from softfinger.daemon.client.stream import read
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema, schema_docs

ENCODING = "json"
SCHEMA_ENCODING = "jsonschema"
PROFILE = "softfinger"

# Recorded frames and events also contain the fields that Foxglove's schemas require. If a stream
# field has the same name as a Foxglove field, the stream field is renamed.
_STAMP = {
    "type": "object",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_WORD, _NUMBER = {"type": "string"}, {"type": "integer"}
_FOXGLOVE: dict[bytes, tuple[str, dict[str, Any]]] = {
    schema.TACTILE: (
        "foxglove.RawImage",
        {"timestamp": _STAMP, "frame_id": _WORD, "width": _NUMBER, "height": _NUMBER}
        | {"encoding": _WORD, "step": _NUMBER},
    ),
    schema.EVENT: (
        "foxglove.Log",
        {"timestamp": _STAMP, "level": _NUMBER, "message": _WORD, "name": _WORD}
        | {"file": _WORD, "line": _NUMBER},
    ),
}
_STORED_AS = {"timestamp": "unix", "level": "severity"}
_LEVELS = {"info": 2, "warning": 3, "error": 4}  # Foxglove's log levels, where 0 means unknown

Converter = Callable[[dict[str, Any]], dict[str, Any]]


def flat(message: dict[str, Any], outer: str = "") -> dict[str, Any]:
    """Flatten nested maps; the entry ``force`` in the map ``left`` becomes ``left.force``."""
    fields: dict[str, Any] = {}
    for key, value in message.items():
        if isinstance(value, dict):
            fields |= flat(value, f"{outer}{key}.")
        else:
            fields[f"{outer}{key}"] = value
    return fields


def channel_name(topic: bytes, message: dict[str, Any]) -> str:
    """Return a message's channel name, formed from the topic and, for a frame, the finger."""
    if topic == schema.TACTILE:
        return f"{topic.decode()}/{message.get('finger')}"
    return topic.decode()


def topic_of(channel: str) -> bytes:
    """Return the topic of a channel's messages."""
    topic = schema.TACTILE.decode()
    return schema.TACTILE if channel.startswith(f"{topic}/") else channel.encode()


def schema_of(topic: bytes) -> tuple[str, dict[str, Any]]:
    """Return the schema name and JSON Schema of a topic; unknown topics may contain any object."""
    if topic not in schema.TOPICS:
        return topic.decode(), {"type": "object"}
    described = schema_docs.json_schema(topic)
    if topic not in _FOXGLOVE:
        return topic.decode().replace("/", "."), described
    name, fields = _FOXGLOVE[topic]
    own = described["properties"].items()
    described["properties"] = fields | {
        _STORED_AS[each] if each in fields else each: field for each, field in own
    }
    return name, described


def to_json(topic: bytes, message: dict[str, Any]) -> dict[str, Any]:
    """Convert a stream map to a channel's JSON; this function may modify ``message``."""
    if topic == schema.TACTILE:
        return _image(message)
    return _log(message) if topic == schema.EVENT else message


def from_json(topic: bytes) -> Converter:
    """Return a function that converts a channel's JSON to the stream's map."""
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    floats = [field.name.split(".") for field in fields if field.kind == "float"]
    return partial(_restored, topic, floats, [field.name for field in fields])


def stamp(unix: object) -> dict[str, int]:
    """Convert a Unix time [s] to Foxglove's form; an invalid time becomes 0."""
    if not isinstance(unix, float) or not 0.0 <= unix < 2.0**32:
        return {"sec": 0, "nsec": 0}
    seconds = math.floor(unix)
    return {"sec": seconds, "nsec": int((unix - seconds) * 1e9)}


def _image(message: dict[str, Any]) -> dict[str, Any]:
    unix = message.pop("timestamp", None)
    width, height = message.get("cols"), message.get("rows")
    data = message.get("data")
    message["data"] = base64.b64encode(data).decode() if isinstance(data, bytes) else ""
    return {
        "timestamp": stamp(unix),
        "frame_id": message.get("finger"),
        "width": width,
        "height": height,
        "encoding": "mono16",
        "step": 2 * width if isinstance(width, int) else 0,
        "unix": unix,
        **message,
    }


def _log(message: dict[str, Any]) -> dict[str, Any]:
    unix, severity = message.pop("timestamp", None), message.pop("level", None)
    return {
        "timestamp": stamp(unix),
        "level": _LEVELS.get(severity, 0) if isinstance(severity, str) else 0,
        "message": message.get("text"),
        "name": message.get("kind"),
        "file": "",
        "line": 0,
        "unix": unix,
        "severity": severity,
        **message,
    }


def _restored(
    topic: bytes, floats: list[list[str]], names: list[str], message: dict[str, Any]
) -> dict[str, Any]:
    """Restore the stream's map from a channel's JSON.

    Null becomes NaN, base64 becomes bytes, and Foxglove's fields are dropped. Raises ValueError,
    TypeError or AttributeError if the map is not a message of this topic.
    """
    if topic in _FOXGLOVE and _STORED_AS["timestamp"] in message:
        for name in _FOXGLOVE[topic][1]:
            message.pop(name, None)
        for name, stored in _STORED_AS.items():
            if stored in message:
                message[name] = message.pop(stored)
        message = {name: message[name] for name in names if name in message} | message
    if topic == schema.TACTILE:
        message["data"] = base64.b64decode(message.get("data") or "")
        frame = read(schema.TactileFrame, message)
        if frame.finger not in FINGERS or not math.isfinite(frame.timestamp):
            raise ValueError("a tactile frame without a finger or a time")
    for path in floats:
        place: Any = message
        for part in path[:-1]:
            place = place.get(part)
            if not isinstance(place, dict):
                break
        else:
            if path[-1] in place and place[path[-1]] is None:
                place[path[-1]] = math.nan
    return message
