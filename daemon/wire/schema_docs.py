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

Written from `daemon/wire/schema.py` by `python -m softfinger.daemon.wire.schema_docs`;
a test keeps it true.

Schema {SCHEMA}. Two frames a message, topic and msgpack map with text keys, in SI units. Fields are
only ever added, none is left out, and none changes its type: a float is always sent as a float. A
field named `left.q` is `q` in the map `left`. Integers are sent in msgpack's
smallest form: JavaScript reads those below 2³² as numbers, and `mono_ns` perhaps as BigInt.

A subscriber that wants the newest state alone can set `ZMQ_CONFLATE`, which drops messages of two
frames. Set `stream.latest = "tcp://127.0.0.1:9874"` in the profile: each `hand/state` then also
goes out on that address, as one frame that holds the map alone. Subscribe there to everything:

```python
newest = zmq.Context.instance().socket(zmq.SUB)
newest.setsockopt(zmq.CONFLATE, 1)
newest.subscribe(b"")
newest.connect("tcp://127.0.0.1:9874")
state = msgpack.unpackb(newest.recv())
```

`timestamp` is the machine's Unix time. `mono_ns` is the daemon's clock, for differences: the
machine's monotonic clock or, of a hand simulated in the daemon, one that waits while the machine is
too busy to keep up (`loop.clock`, `behind_s`). Durations (`tick_s`, `compute_s`, `hand/stats`) are
in the machine's time.
"""


_COMMANDS = """\
## Commands

A command is one msgpack map, `{"command": "grasp", "force": 5.0}`, and so is its reply:
`{"ok": true, …}` or `{"ok": false, "error": …, "reason": …}`. `error` is for people. `reason` is
one of these texts:

| reason | meaning |
|---|---|
"""

_KEYS = """\

Any socket may send a command that may talk to a REP socket: REQ, also with `REQ_CORRELATE`, and
DEALER. The reply begins with all frames up to the first empty one. A DEALER may leave out the empty
frame; its reply has none either. A command in several frames, or in an envelope of more than 14
frames or 1,024 bytes, is refused as `request`.

After a stall of the daemon, the commands that waited are older than their clients expected. `arm`
and all commands that move the hand or change its grip are then refused as `late` if they are older
than 0.2 s (or `servos.watchdog`, where that is shorter). `disarm`, `tare`, `clear`, and a `hold`
while the hand grips, are carried out up to an age of 1 s, `status` and `stop` always.

To send a late command again safely, give it a `key`: a text of 1 to 64 characters that no other
command has, for example a random number. Send the same map again. The daemon carries it out at most
once, and answers a repetition with the first reply. It refuses the repetition as `stopped` if the
hand was stopped since it refused the first one as late, and as `superseded` if it has carried out
another command since. `disarm` needs no key; it is carried out each time. `Hand`, `AsyncHand`,
`softfinger send`, `monitor` and `view` repeat late commands by themselves.
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
