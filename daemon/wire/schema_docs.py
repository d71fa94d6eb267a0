"""Documentation of the schema: the page ``STREAM.md``, and JSON Schema for recordings.

``python -m softfinger.daemon.wire.schema_docs`` regenerates the page.
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

This page is generated from `daemon/wire/schema.py` by
`python -m softfinger.daemon.wire.schema_docs`.

This is schema {SCHEMA}. A message has two frames: the topic, and a msgpack map with text keys.
Values are in SI units. A field named `left.q` is `q` in the map `left`. Messages always contain all
fields. New versions may add fields, but never remove a field or change its type: a float is always
sent as a float. Integers use the shortest msgpack format, so JavaScript reads integers below 2³² as
numbers. It may read `mono_ns` as BigInt.

A subscriber that only needs the newest state can use `ZMQ_CONFLATE`. This option does not support
two-frame messages, so set `stream.latest = "tcp://127.0.0.1:9874"` in the profile. The daemon then
also publishes each `hand/state` at this address, as a single frame that contains the map. Subscribe
to all messages there:

```python
newest = zmq.Context.instance().socket(zmq.SUB)
newest.setsockopt(zmq.CONFLATE, 1)
newest.subscribe(b"")
newest.connect("tcp://127.0.0.1:9874")
state = msgpack.unpackb(newest.recv())
```

`timestamp` is Unix time. For time differences, use `mono_ns`, the daemon's clock, which is the
machine's monotonic clock. If the daemon simulates the hand, this clock waits while the machine is
too busy to keep up (`loop.clock`, `behind_s`). Durations (`tick_s`, `compute_s`, `hand/stats`) are
always measured in the machine's time.
"""


_COMMANDS = """\
## Commands

A command is one msgpack map, for example `{"command": "grasp", "force": 5.0}`. The reply is also a
map: `{"ok": true, …}` or `{"ok": false, "error": …, "reason": …}`. `error` is a message for the
user, and `reason` is one of these words:

| reason | meaning |
|---|---|
"""

_KEYS = """\

Send commands from a REQ socket, with or without `REQ_CORRELATE`, or from a DEALER socket. As with a
REP socket, the reply begins with all frames of the request up to the first empty one. A DEALER
socket may omit the empty frame; the reply then omits it as well. A command with several frames, or
with an envelope of more than 14 frames or 1,024 bytes, is rejected with the reason `request`.

After a stall of the daemon, the waiting commands are older than their clients expected. `arm` and
all commands that move the hand or change its grip are rejected as `late` if they are older than
0.2 s or `servos.watchdog`, whichever is shorter. `disarm`, `tare`, `clear`, and a `hold` while the
hand grips are accepted up to an age of 1 s. `status` and `stop` are always accepted.

To make a late command safe to repeat, give it a `key`: a unique text of 1 to 64 characters, for
example a random number. Then send the same map again. The daemon executes the command at most once
and responds to a repetition with the first reply. A repetition is rejected as `stopped` if the hand
was stopped after the first rejection, and as `superseded` if another command has been executed
since then. `disarm` does not need a key, because it is executed every time. `Hand`, `AsyncHand`,
`softfinger send`, `monitor` and `view` repeat late commands automatically.
"""


def json_schema(topic: bytes) -> dict[str, Any]:
    """Return the JSON Schema of a topic's map; bytes are base64, and NaN and infinity are null."""
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
    """Return the page ``STREAM.md`` in Markdown."""
    reasons = "".join(f"| `{reason}` | {reason.meaning} |\n" for reason in Reason)
    parts = [_INTRODUCTION, _COMMANDS + reasons + _KEYS]
    for name, topic in TOPICS.items():
        rows = [f"| `{f.name}` | {f.kind} | {f.unit} | {f.meaning} |" for f in topic.fields]
        table = "\n".join(["| field | type | unit | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## `{name.decode()}`\n\n{topic.summary}\n\n{table}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    Path(__file__).with_name("STREAM.md").write_text(page(), encoding="utf-8")
