"""Generate the stream's documentation page ``STREAM.md`` and the JSON Schemas of recordings.

``python -m softfinger.daemon.wire.schema_docs`` writes the page.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softfinger.daemon.errors import Reason
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

To read the hand's state in any language, subscribe to the daemon's ZeroMQ socket
(`stream.address`) and unpack each message with msgpack. In Python, the `softfinger.Hand` class
subscribes and unpacks. This page lists all messages and their fields. It is generated from
`daemon/wire/schema.py` by `python -m softfinger.daemon.wire.schema_docs`.

Each message has two frames: the topic, and a msgpack map whose keys are strings. Values are in SI
units. `left.q` means the entry `q` of the map that is stored under the key `left`. A message always
contains all fields. This page describes schema {SCHEMA}. New versions may add fields, but never
remove a field or change its type. A float is always sent as a float. An integer is sent in the
smallest msgpack format. JavaScript therefore reads integers below 2³² as numbers, and may read
`mono_ns` as a BigInt.

A subscriber that needs only the newest state can use `ZMQ_CONFLATE`. This option does not support
messages with two frames. For such subscribers, set `stream.latest = "tcp://127.0.0.1:9874"` in the
profile. The daemon then also publishes each `hand/state` at this address, as a single frame that
contains only the map. Subscribe to all messages at this address:

```python
newest = zmq.Context.instance().socket(zmq.SUB)
newest.setsockopt(zmq.CONFLATE, 1)
newest.subscribe(b"")
newest.connect("tcp://127.0.0.1:9874")
state = msgpack.unpackb(newest.recv())
```

`timestamp` is Unix time. To compute time differences, use `mono_ns`, the time of the daemon's
clock. This clock is normally the machine's monotonic clock. If the hand is simulated in the daemon,
the daemon's clock pauses while the machine is too busy to keep up (`loop.clock`, `behind_s`).
Durations (`tick_s`, `compute_s`, `hand/stats`) are always measured with the machine's clock.
"""


_COMMANDS = """\
## Commands

A command is a msgpack map, for example `{"command": "grasp", "force": 5.0}`. The reply is also a
map: `{"ok": true, …}` or `{"ok": false, "error": …, "reason": …}`. `error` is a message for the
user, and `reason` is one of these strings for programs:

| reason | meaning |
|---|---|
"""

_KEYS = """\

Send commands from a REQ socket, with or without `REQ_CORRELATE`, or from a DEALER socket. As with a
REP socket, the reply begins with all frames of the request up to and including the first empty
frame. A DEALER socket may omit the empty frame; the reply then omits the empty frame as well. The
daemon rejects commands that span several frames, and envelopes of more than 14 frames or 1,024
bytes. The reason in the reply is then `request`.

**Late commands.** If the daemon stalls, commands wait longer than their clients expect. The daemon
therefore rejects outdated commands as `late`. `arm` and all commands that move the hand or change
its grip are rejected if they are older than 0.2 s or `servos.watchdog`, whichever is shorter.
`disarm`, `tare`, `clear`, and `hold` during a grip are accepted if they are at most 1 s old.
`status` and `stop` are always accepted.

**Repeated commands.** To make a late command safe to repeat, add a `key` to the command: a
unique string of 1 to 64 characters, for example a random number. To repeat the command, send the
same map again. The daemon carries out the command at most once, and sends the reply of the executed
command again for each further repetition. The daemon remembers only the last 256 commands with a
key, of all clients together. It treats the repetition of an older command as a new command. If the
hand was stopped after the first rejection, the repetition is rejected as `stopped`. If another
command was carried out after the first rejection, the repetition is rejected as `superseded`.
`disarm` needs no key, because repeating it is harmless.
`Hand`, `AsyncHand`, `softfinger send`, `monitor` and `view` repeat late commands automatically.
"""


def json_schema(topic: bytes) -> dict[str, Any]:
    """Return the JSON Schema of a topic's map, with base64 for bytes and null for NaN and ±∞."""
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
    """Return the Markdown text of the ``STREAM.md`` page."""
    reasons = "".join(f"| `{reason}` | {reason.meaning} |\n" for reason in Reason)
    parts = [_INTRODUCTION, _COMMANDS + reasons + _KEYS]
    for name, topic in TOPICS.items():
        rows = [f"| `{f.name}` | {f.kind} | {f.unit} | {f.meaning} |" for f in topic.fields]
        table = "\n".join(["| field | type | unit | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## `{name.decode()}`\n\n{topic.summary}\n\n{table}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    Path(__file__).with_name("STREAM.md").write_text(page(), encoding="utf-8")
