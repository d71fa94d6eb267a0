"""The stream's contract: every field of every topic, its type, unit and meaning.

`wire.messages` makes the maps; here stands what is in them, for those who read them: the page
``daemon/wire/STREAM.md`` is written from this table, and so are the schemas in recordings. A field
of a map within the map has a dot in its name.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import messages

Kind = Literal["int", "float", "bool", "str", "bin"]


class Field(NamedTuple):
    """One field. ``unit`` is empty where there is none; ``since`` is the schema it came with."""

    name: str
    kind: Kind
    unit: str
    meaning: str
    since: int = 1


_ALL = (
    Field("schema", "int", "", "number of this contract; changes only when a field's meaning does"),
    Field("seq", "int", "", "counts up: ticks, frames, events"),
    Field("timestamp", "float", "s", "Unix time"),
)

_STEP = Field("seq_step", "int", "", "one of so many is sent")
_SENT = (*_ALL[:2], _STEP, *_ALL[2:])

_FINGER = (
    Field("valid", "bool", "", "takes part, and servos and sensors gave fresh, sound numbers"),
    Field("q", "float", "rad", "joint angle, positive closes"),
    Field("dq", "float", "rad/s", "joint velocity"),
    Field("current", "float", "A", "motor current, positive closes"),
    Field("temperature", "float", "°C", "of the servo, 0 while not known"),
    Field("voltage", "float", "V", "of the servo's supply, 0 while not known"),
    Field("goal_q", "float", "rad", "goal angle"),
    Field("goal_current", "float", "A", "bound on the current's magnitude"),
    Field("d", "float", "m", "maximum displacement of the tip"),
    Field("theta", "float", "rad", "the object's angle in the tip's frame, in the hand's plane"),
    Field("tilt_y", "float", "rad", "and across the plane"),
    Field("force", "float", "N", "elastic force F(d, θ)"),
    Field("energy", "float", "J", "elastic potential energy U(d, θ)"),
    Field("d_std", "float", "m", "standard deviation of d"),
    Field("theta_std", "float", "rad", "standard deviation of theta"),
    Field("gain", "float", "", "measured over modelled pressure"),
    Field("misfit", "bool", "", "the frame fits no contact of the model: d, theta may be biased"),
    Field("contact", "bool", "", "something touches the tip"),
    Field(
        "frame_seq", "int", "", "the tactile frame that the estimate rests on, 0 before the first"
    ),
    Field("frame_age_s", "float", "s", "age of that frame's sample"),
)

_STATE = (
    *_SENT,
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock at the tick"),
    Field(
        "mode", "str", "", "disarmed, armed, moving, grasping, holding, rotating, releasing, fault"
    ),
    Field("fault", "str", "", "reason of the latched fault, empty when none"),
    Field(
        "fault_name",
        "str",
        "",
        "the fault's name in `softfinger.daemon.safety.limits`, empty when none",
    ),
    Field("torque", "bool", "", "torque is on, or not known to be off"),
    Field("tick_s", "float", "s", "from the last tick's start to this one's"),
    Field("compute_s", "float", "s", "work of the last tick"),
    Field("wake_late_s", "float", "s", "this tick's start after its deadline"),
    Field("overruns", "int", "", "ticks whose work outlasted the period"),
    Field(
        "behind_s",
        "float",
        "s",
        "how long a hand simulated in the daemon has waited for a busy machine since the start: "
        "what its time is behind by; 0 for other hands",
    ),
    Field(
        "goal_force",
        "float",
        "N",
        "the tips' mean force that the grip goes to: what was asked for, or more where the tips "
        "would slip; no number without a grip",
    ),
    Field(
        "goal_angle",
        "float",
        "rad",
        "the object's angle that the grip turns to or keeps; no number where it keeps none",
    ),
    *(
        part._replace(name=f"{finger}.{part.name}", meaning=f"{finger} finger: {part.meaning}")
        for finger in FINGERS
        for part in _FINGER
    ),
    Field("object.valid", "bool", "", "both contacts tell the object's pose"),
    Field(
        "object.angle",
        "float",
        "rad",
        "the object's angle in the hand's frame: of its faces' bisector; "
        "of a disc that of the line between the contacts",
    ),
    Field("object.width", "float", "m", "the object's width between the tips"),
)

_TACTILE = (
    *_SENT[:3],
    Field("number", "int", "", "counts this sensor's messages: a gap is a loss on the way"),
    *_SENT[3:],
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock at the board's scan"),
    Field("delay_s", "float", "s", "from the scan until the frame had come"),
    Field("valid", "bool", "", "false: the board is gone, this is its last frame again"),
    Field("finger", "str", "", "left or right"),
    Field("rows", "int", "", "cells along y"),
    Field("cols", "int", "", "cells along x"),
    Field("pitch", "float", "m", "from column to column"),
    Field("pitch_y", "float", "m", "from row to row"),
    Field("centre_x", "float", "m", "the tip's centre off the grid's, along x"),
    Field("centre_y", "float", "m", "and along y"),
    Field("rotation", "float", "rad", "of the sensor's axes against the finger's"),
    Field("unit", "str", "", "`count`: what the board said; `Pa`: what the estimator was given"),
    Field("scale", "float", "Pa", "one step of the data, as well as one factor can tell"),
    Field("calibrated", "bool", "", "data × scale is the pressure by the calibration"),
    Field("calibration", "str", "", "name and date of the estimator's calibration, or empty"),
    Field("data", "bin", "", "rows × cols little-endian uint16, row by row"),
)

_TOLD = (
    *_ALL[:2],
    Field("again", "bool", "", "told again for a late subscriber, with its first seq and times"),
    *_ALL[2:],
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock"),
)

_TAKEN = (
    Field("q", "float", "rad", "joint angle"),
    Field("dq", "float", "rad/s", "joint velocity"),
    Field("current", "float", "A", "motor current"),
    Field("hardware", "int", "", "the servo's hardware error bits, 0 if not known"),
    Field("temperature", "float", "°C", "of the servo, 0 while not known"),
    Field("voltage", "float", "V", "of its supply, 0 while not known"),
    Field("frame_seq", "int", "", "newest tactile frame, 0 before the first"),
    Field("frame_t", "float", "s", "when it was scanned, by the daemon's clock"),
    Field("frame_arrival", "float", "s", "when it was complete here"),
    Field("frame_valid", "bool", "", "false: the board is gone"),
)

_INPUT = (
    *_ALL,
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock at the tick"),
    Field("t", "float", "s", "the same, with all its digits"),
    Field("late_in_row", "int", "", "overruns in a row, up to this tick"),
    Field("busy_s", "float", "s", "how long this machine has just kept the loop from a tick, or 0"),
    Field("reading.seq", "int", "", "readings of the servos"),
    Field("reading.t", "float", "s", "when the last good one was taken; no number before it"),
    Field("reading.valid", "bool", "", "this tick's is good"),
    Field("reading.alert", "int", "", "bit i: servo of finger i reports a hardware error"),
    Field("reading.error", "str", "", "what the bus failed with, or empty"),
    Field("reading.lost", "int", "", "bit i: servo of finger i holds none of the last goals sent"),
    Field("reading.frozen", "int", "", "bit i: servo of finger i measures nothing new"),
    *(
        part._replace(name=f"{finger}.{part.name}", meaning=f"{finger} finger: {part.meaning}")
        for finger in FINGERS
        for part in _TAKEN
    ),
    Field("write_error", "str", "", "what the bus failed with when written to, or empty"),
    Field("torque_off", "bool", "", "the servos confirmed at this tick that torque is off"),
)

_TRUE = (
    Field("d", "float", "m", "maximum displacement of the tip, negative: a gap"),
    Field("theta", "float", "rad", "the object's angle in the tip's frame"),
    Field("force", "float", "N", "on the tip's base"),
)

_TRUTH = (
    *_SENT,
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock at the tick"),
    *(
        part._replace(name=f"{finger}.{part.name}", meaning=f"{finger} finger: {part.meaning}")
        for finger in FINGERS
        for part in _TRUE
    ),
    Field("object.x", "float", "m", "the object's centre in the hand's frame"),
    Field("object.y", "float", "m", "and along y"),
    Field("object.angle", "float", "rad", "the object's angle in the hand's frame"),
)

_SETTINGS = (
    *_TOLD,
    Field("version", "str", "", "of softfinger"),
    Field("settings", "str", "", "all settings, as JSON"),
    Field("calibration_left", "str", "", "the left sensor's calibration as JSON, or empty"),
    Field("calibration_right", "str", "", "the right sensor's"),
    Field("table_left", "str", "", "the left tip's contact table: form, tolerance, certificate"),
    Field("table_right", "str", "", "the right tip's"),
)

_COMMAND = (
    *_TOLD,
    Field("tick", "int", "", "seq of the tick at which it was answered"),
    Field("command", "str", "", "its name"),
    Field("client", "str", "", "who sent it, empty for all who give no name"),
    Field("request", "str", "", "all of it, as JSON"),
    Field("ok", "bool", "", "carried out"),
    Field("error", "str", "", "why it was refused, empty when it was carried out"),
)

_EVENT = (
    *_TOLD,
    Field("level", "str", "", "info, warning or error"),
    Field("kind", "str", "", "what it is about: mode, fault, servos, …"),
    Field("text", "str", "", "one line for a person"),
)

_TIMES = {
    "wake": "a tick's start after its deadline",
    "compute": "all of a tick's work",
    "bus": "reading and writing the servos",
    "publish": "publishing",
}
_SHARES = {
    "p50": "median",
    "p99": "99 % are below",
    "p999": "99.9 % are below",
    "max": "longest",
}
_RATES = {
    "tick": "ticks",
    "left": "tactile frames that came from the left sensor",
    "right": "tactile frames that came from the right sensor",
    "state": "states that went out",
    "tactile": "tactile frames that went out",
}

_STATS = (
    *_SENT,
    Field("mono_ns", "int", "ns", "the daemon's monotonic clock"),
    Field("ticks", "int", "", "ticks since the start, which all but the rates count from"),
    Field("overruns", "int", "", "ticks whose work outlasted the period"),
    Field("period_s", "float", "s", "the tick's period"),
    *(
        Field(f"{part}.{share}", "float", "s", f"{what}: {meaning}")
        for part, what in _TIMES.items()
        for share, meaning in _SHARES.items()
    ),
    *(
        Field(f"rates.{name}", "float", "Hz", f"{what}, over the last second")
        for name, what in _RATES.items()
    ),
)

TOPICS: dict[bytes, tuple[Field, ...]] = {
    messages.STATE: _STATE,
    messages.TACTILE: _TACTILE,
    messages.EVENT: _EVENT,
    messages.STATS: _STATS,
    messages.SETTINGS: _SETTINGS,
    messages.COMMAND: _COMMAND,
    messages.INPUT: _INPUT,
    messages.TRUTH: _TRUTH,
}

_SUMMARY = {
    messages.STATE: "What the hand is, does and feels, every n-th tick (`stream.state_rate`).",
    messages.TACTILE: "The grids' raw frames (`stream.tactile_rate`), one finger a message.",
    messages.EVENT: "What happened: modes, faults, warnings; the last 50 again for whoever comes.",
    messages.STATS: "Once a second, how the loop keeps its time.",
    messages.SETTINGS: "Once, and again for whoever subscribes later: what this hand is.",
    messages.INPUT: "All that a tick took in, every tick: what `replay --recompute` starts from.",
    messages.TRUTH: "A simulated hand's own knowledge, with each state. No real hand has it.",
    messages.COMMAND: "Each command that was answered, by whomever; `status` is left out.",
}

_JSON: dict[Kind, dict[str, Any]] = {
    "int": {"type": "integer"},
    "float": {"type": ["number", "null"]},
    "bool": {"type": "boolean"},
    "str": {"type": "string"},
    "bin": {"type": "string", "contentEncoding": "base64"},
}


def json_schema(topic: bytes) -> dict[str, Any]:
    """The topic's map as JSON Schema. Bytes are base64, a float that is no number is null."""
    schema: dict[str, Any] = {
        "title": topic.decode(),
        "description": _SUMMARY[topic],
        "type": "object",
        "properties": {},
    }
    for field in TOPICS[topic]:
        *outer, name = field.name.split(".")
        place = schema["properties"]
        for part in outer:
            place = place.setdefault(part, {"type": "object", "properties": {}})["properties"]
        unit = f" [{field.unit}]" if field.unit else ""
        place[name] = {**_JSON[field.kind], "description": field.meaning + unit}
    return schema


def page() -> str:
    """The page for people, in Markdown."""
    lines = [
        "# The stream",
        "",
        "Written from `daemon/wire/schema.py` by `python -m softfinger.daemon.wire.schema`;",
        "a test keeps it true.",
        "",
        f"Schema {messages.SCHEMA}. Two frames a message, topic and msgpack map with text keys,",
        "in SI units. Fields are only ever added, none is left out, and none changes its type:",
        "a float is always sent as a float. A field named `left.q` is `q` in the map `left`.",
        "The integers of `hand/state` and `hand/input` take 64 bits whatever their value, so that",
        "while its texts stay the same, each message of such a topic is laid out as the last one.",
        "",
        "`timestamp` is the machine's Unix time. `mono_ns` is the time that the hand lives in, for",
        "differences: the machine's monotonic clock or, of a hand simulated in the daemon, one",
        "that waits while the machine is too busy to keep up (`loop.clock`, `behind_s`). How long",
        "things took (`tick_s`, `compute_s`, `hand/stats`) is in the machine's time.",
    ]
    for topic, fields in TOPICS.items():
        lines += [
            "",
            f"## `{topic.decode()}`",
            "",
            _SUMMARY[topic],
            "",
            "| field | type | unit | meaning | since |",
            "|---|---|---|---|---|",
        ]
        lines += [
            f"| `{field.name}` | {field.kind} | {field.unit} | {field.meaning} | {field.since} |"
            for field in fields
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    from pathlib import Path

    Path(__file__).with_name("STREAM.md").write_text(page(), encoding="utf-8")
