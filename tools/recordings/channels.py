"""How a topic's map becomes a channel's JSON, and back: what the writer and the reader share."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from typing import Any

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema, schema_docs

ENCODING = "json"
SCHEMA_ENCODING = "jsonschema"
PROFILE = "softfinger"
LIBRARY = "softfinger"
_IMAGE = "foxglove.RawImage"
_TACTILE = tuple(field.name for field in schema.TOPICS[schema.TACTILE].fields)  # in their order

_MOST_CELLS = 4096  # in a row or column

Converter = Callable[[dict[str, Any]], dict[str, Any]]


def channel_name(topic: bytes, message: dict[str, Any]) -> str:
    """The channel of a message: its topic, for frames with the finger's name behind it."""
    if topic == schema.TACTILE:
        return f"{topic.decode()}/{message.get('finger')}"
    return topic.decode()


def topic_of(channel: str) -> bytes:
    """The topic whose messages a channel holds."""
    topic = schema.TACTILE.decode()
    return schema.TACTILE if channel.startswith(f"{topic}/") else channel.encode()


def schema_of(topic: bytes) -> tuple[str, dict[str, Any]]:
    """Name and JSON schema of a topic's channels; anything is an object where we know no more."""
    if topic not in schema.TOPICS:
        return topic.decode(), {"type": "object"}
    described = schema_docs.json_schema(topic)
    if topic != schema.TACTILE:
        return topic.decode().replace("/", "."), described
    own = described["properties"]
    stamp = {
        "type": "object",
        "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
    }
    described["properties"] = {
        "timestamp": stamp,
        "frame_id": {"type": "string"},
        "width": {"type": "integer"},
        "height": {"type": "integer"},
        "encoding": {"type": "string"},
        "step": {"type": "integer"},
        **{("unix" if name == "timestamp" else name): field for name, field in own.items()},
    }
    return _IMAGE, described


def to_json(topic: bytes) -> Converter:
    """What makes a map fit for JSON. The map may be changed."""
    return _image if topic == schema.TACTILE else _as_it_is


def from_json(topic: bytes) -> Converter:
    """What makes the map of the wire from a channel's JSON."""
    fields = schema.TOPICS[topic].fields if topic in schema.TOPICS else ()
    floats = [field.name.split(".") for field in fields if field.kind == "float"]
    return _Restored(floats, topic == schema.TACTILE)


def _as_it_is(message: dict[str, Any]) -> dict[str, Any]:
    return message


def _image(message: dict[str, Any]) -> dict[str, Any]:
    unix = message.pop("timestamp", None)
    sound = isinstance(unix, float) and math.isfinite(unix) and 0.0 <= unix < 2.0**32
    seconds = math.floor(unix) if sound else 0
    width, height = message.get("cols"), message.get("rows")
    data = message.get("data")
    message["data"] = base64.b64encode(data).decode() if isinstance(data, bytes) else ""
    return {
        "timestamp": {"sec": seconds, "nsec": int((unix - seconds) * 1e9) if sound else 0},
        "frame_id": message.get("finger"),
        "width": width,
        "height": height,
        "encoding": "mono16",
        "step": 2 * width if isinstance(width, int) else 0,
        "unix": unix,
        **message,
    }


def _is_frame(message: dict[str, Any]) -> bool:
    """Whether a map is a frame: a finger's, with a time and as many cells as rows × cols."""
    rows, cols, stamp = (message.get(name) for name in ("rows", "cols", "timestamp"))
    return (
        message.get("finger") in FINGERS
        and isinstance(stamp, float)
        and math.isfinite(stamp)
        and type(rows) is type(cols) is int
        and 0 < rows <= _MOST_CELLS
        and 0 < cols <= _MOST_CELLS
        and len(message["data"]) == 2 * rows * cols
    )


class _Restored:
    """Nulls are NaN again, bytes are bytes, and an image is the topic's own map.

    Raises ValueError, TypeError or AttributeError for what is no message of the topic.
    """

    _IMAGE_ALONE = ("timestamp", "frame_id", "width", "height", "encoding", "step")

    def __init__(self, floats: list[list[str]], image: bool) -> None:
        self._floats = floats
        self._image = image

    def __call__(self, message: dict[str, Any]) -> dict[str, Any]:
        if self._image:
            for name in self._IMAGE_ALONE:
                message.pop(name, None)
            message["timestamp"] = message.pop("unix", math.nan)
            message["data"] = base64.b64decode(message.get("data") or "")
            message = {name: message[name] for name in _TACTILE if name in message} | message
            if not _is_frame(message):
                raise ValueError("a tactile frame whose fields do not fit together")
        for path in self._floats:
            place: Any = message
            for part in path[:-1]:
                place = place.get(part)
                if not isinstance(place, dict):
                    break
            else:
                if path[-1] in place and place[path[-1]] is None:
                    place[path[-1]] = math.nan
        return message
