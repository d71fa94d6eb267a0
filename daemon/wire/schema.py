"""The stream's schema: every field of every topic, declared once.

A topic is a record. Each of its fields has a unit, the expression that the daemon takes it from,
and a meaning. From it follow the packers (`wire.packer`), the records that clients read
(`client.records`), the page ``STREAM.md`` and the JSON schemas of recordings (`wire.schema_page`).

Fields are only ever added, none is left out, and a float is always sent as a float. SI units.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import FINGERS

SCHEMA = 1
STATE = b"hand/state"
TACTILE = b"hand/tactile"
EVENT = b"hand/event"
STATS = b"hand/stats"
SETTINGS = b"hand/settings"
COMMAND = b"hand/command"
INPUT = b"hand/input"
TRUTH = b"hand/truth"

_Record = TypeVar("_Record")
_KINDS = {int: "int", float: "float", bool: "bool", str: "str", bytes: "bin"}


class Field(NamedTuple):
    """One number or text of a topic's map. A field of a map within the map has a dot in its name.

    ``kind`` is int, float, bool, str or bin; ``unit`` is empty where there is none; ``source`` is a
    Python expression over the topic's arguments.
    """

    name: str
    kind: str
    unit: str
    source: str
    meaning: str


class Topic(NamedTuple):
    """One topic: the record of its messages, and what they are made from.

    ``arguments`` are those of the function that makes a message, ``names`` what its sources call
    parts of them.
    """

    record: type[Any]
    summary: str
    arguments: str
    names: dict[str, str]
    fields: tuple[Field, ...]


TOPICS: dict[bytes, Topic] = {}


def field(unit: str, source: str, meaning: str) -> Any:
    """Declare a field of a record."""
    return dataclasses.field(metadata={"unit": unit, "source": source, "meaning": meaning})


def part(prefix: str = "", **places: object) -> Any:
    """Declare a map within the map: before its meanings comes ``prefix``.

    ``places`` are filled into its sources.
    """
    return dataclasses.field(metadata={"prefix": prefix, "places": places})


@dataclass_transform(frozen_default=True, field_specifiers=(field, part))
def record(cls: type[_Record]) -> type[_Record]:
    """Make a record of a class of declared fields."""
    return dataclasses.dataclass(frozen=True, slots=True)(cls)


def topic(
    name: bytes, summary: str, arguments: str, **names: str
) -> Callable[[type[_Record]], type[_Record]]:
    """Declare that a record is a topic's."""

    def declare(cls: type[_Record]) -> type[_Record]:
        TOPICS[name] = Topic(cls, summary, arguments, names, tuple(fields_of(cls)))
        return cls

    return declare


def fields_of(
    cls: type[Any], outer: str = "", prefix: str = "", places: dict[str, Any] | None = None
) -> Iterator[Field]:
    """All fields of a record in their order, those of records within it with a dot."""
    for each in dataclasses.fields(cls):
        name, told = outer + each.name, each.metadata
        if isinstance(each.type, type) and each.type in _KINDS:
            source = told["source"].format(**places or {})
            yield Field(name, _KINDS[each.type], told["unit"], source, prefix + told["meaning"])
        else:
            assert isinstance(each.type, type)
            yield from fields_of(each.type, f"{name}.", told["prefix"], told["places"])


# What several topics begin with.
_SCHEMA = "", "SCHEMA", "number of this schema; changes only when a field's meaning does"
_SEQ = "", "seq", "counts up: ticks, frames, events"
_STEP = "", "step", "one of so many is sent"
_UNIX = "s", "wall", "Unix time"
_MONO = "ns", "int(t * 1e9)", "the daemon's monotonic clock at the tick"
_TICK = {"seq": "state.seq", "wall": "state.wall", "t": "state.t"}
_TEMPERATURE = "°C", "reading.temperature[{i}]", "of the servo, 0 while not known"
_VOLTAGE = "V", "reading.voltage[{i}]", "of the servo's supply, 0 while not known"


@record
class _TickMessage:
    """What is sent every so many ticks."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    seq_step: int = field(*_STEP)
    timestamp: float = field(*_UNIX)
    mono_ns: int = field(*_MONO)


@record
class _Announcement:
    """What is sent when it happens."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    again: bool = field("", "False", "repeated for a late subscriber, with its first seq and times")
    timestamp: float = field(*_UNIX)
    mono_ns: int = field("ns", "int(t * 1e9)", "the daemon's monotonic clock")


@record
class FingerState:
    """One finger in ``hand/state``."""

    valid: bool = field(
        "",
        "scene.fingers[{i}] and read and (contact{i}.valid or not scene.sensors)",
        "takes part, and servos and sensors gave fresh, sound numbers",
    )
    q: float = field("rad", "reading.q[{i}]", "joint angle, positive closes")
    dq: float = field("rad/s", "reading.dq[{i}]", "joint velocity")
    current: float = field("A", "reading.current[{i}]", "motor current, positive closes")
    temperature: float = field(*_TEMPERATURE)
    voltage: float = field(*_VOLTAGE)
    goal_q: float = field("rad", "goal.q[{i}]", "goal angle")
    goal_current: float = field("A", "goal.current[{i}]", "bound on the current's magnitude")
    d: float = field("m", "contact{i}.d", "maximum displacement of the tip")
    theta: float = field(
        "rad", "contact{i}.theta", "the object's angle in the tip's frame, in the hand's plane"
    )
    tilt_y: float = field("rad", "contact{i}.tilt_y", "and across the plane")
    force: float = field("N", "contact{i}.force", "elastic force F(d, θ)")
    energy: float = field("J", "contact{i}.energy", "elastic potential energy U(d, θ)")
    d_std: float = field("m", "contact{i}.d_std", "standard deviation of d")
    theta_std: float = field("rad", "contact{i}.theta_std", "standard deviation of theta")
    gain: float = field("", "contact{i}.gain", "measured over modelled pressure")
    misfit: bool = field(
        "", "contact{i}.misfit", "the frame fits no contact of the model: d, theta may be biased"
    )
    contact: bool = field("", "contact{i}.contact", "something touches the tip")
    frame_seq: int = field("", "contact{i}.seq", "the estimate's tactile frame, 0 before the first")
    frame_age_s: float = field(
        "s", "t - contact{i}.t if contact{i}.seq else 0.0", "age of that frame's sample"
    )


@record
class ObjectState:
    """The object in ``hand/state``, from the two contacts."""

    valid: bool = field("", "pose.valid", "both contacts tell the object's pose")
    angle: float = field(
        "rad",
        "pose.angle",
        "the object's angle in the hand's frame: of its faces' bisector; "
        "of a disc that of the line between the contacts",
    )
    width: float = field("m", "pose.width", "the object's width between the tips")


@topic(
    STATE,
    "What the hand is, does and feels, every n-th tick (`stream.state_rate`).",
    "state, scene, step=1",
    **_TICK,
    timing="state.timing",
    reading="state.reading",
    goal="state.goal",
    pose="state.object",
    read="reading.valid or not scene.servos",
    contact0="state.contacts[0]",
    contact1="state.contacts[1]",
)
@record
class HandState(_TickMessage):
    """One ``hand/state``."""

    mode: str = field(
        "",
        "state.mode",
        "disarmed, armed, moving, grasping, holding, rotating, releasing, fault",
    )
    fault: str = field("", "state.fault", "reason of the latched fault, empty when none")
    fault_name: str = field(
        "",
        "state.fault_name",
        "the fault's name in `softfinger.daemon.safety.limits`, empty when none",
    )
    torque: bool = field("", "state.torque", "torque is on, or not known to be off")
    tick_s: float = field("s", "timing.tick_s", "from the last tick's start to this one's")
    compute_s: float = field("s", "timing.compute_s", "work of the last tick")
    wake_late_s: float = field("s", "timing.wake_late_s", "this tick's start after its deadline")
    overruns: int = field("", "timing.overruns", "ticks whose work outlasted the period")
    behind_s: float = field(
        "s",
        "timing.behind_s",
        "how long a hand simulated in the daemon has waited for a busy machine since the start; "
        "0 for other hands",
    )
    goal_force: float = field(
        "N",
        "goal.force",
        "mean tip force that the grip aims at: as commanded, or more where the tips would slip; "
        "NaN without a grip",
    )
    goal_angle: float = field(
        "rad", "goal.angle", "object angle that the grip turns to or keeps; NaN where it keeps none"
    )
    left: FingerState = part("left finger: ", i=0)
    right: FingerState = part("right finger: ", i=1)
    object: ObjectState = part()

    def finger(self, name: str) -> FingerState:
        """``left`` or ``right`` by its name. Raises ValueError for another."""
        if name not in FINGERS:
            raise ValueError(f"found finger {name!r}, expected one of {', '.join(FINGERS)}")
        return self.left if name == FINGERS[0] else self.right


@topic(
    TACTILE,
    "The grids' raw frames (`stream.tactile_rate`), one finger a message.",
    "frame, data, finger, facts, wall, step=1, number=0",
    seq="frame.seq",
    t="frame.t_sample",
)
@record
class TactileFrame:
    """One ``hand/tactile``. Raises ValueError when its data isn't a grid of rows × cols."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    seq_step: int = field(*_STEP)
    number: int = field("", "number", "counts this sensor's messages: a gap is a loss on the way")
    timestamp: float = field(*_UNIX)
    mono_ns: int = field("ns", "int(t * 1e9)", "the daemon's monotonic clock at the board's scan")
    delay_s: float = field("s", "frame.t_arrival - t", "from the scan until the frame had come")
    valid: bool = field("", "frame.valid", "false: the board is gone, this is its last frame again")
    finger: str = field("", "FINGERS[finger]", "left or right")
    rows: int = field("", "data.shape[0]", "cells along y")
    cols: int = field("", "data.shape[1]", "cells along x")
    pitch: float = field("m", "facts.pitch", "from column to column")
    pitch_y: float = field("m", "facts.pitch_y", "from row to row")
    centre_x: float = field("m", "facts.centre_x", "the tip's centre off the grid's, along x")
    centre_y: float = field("m", "facts.centre_y", "and along y")
    rotation: float = field("rad", "facts.rotation", "of the sensor's axes against the finger's")
    unit: str = field("", "facts.unit", "`count`: as the board sent it; `Pa`: as it was estimated")
    scale: float = field("Pa", "facts.scale", "one step of the data, as well as one factor can say")
    calibrated: bool = field(
        "", "facts.calibrated", "data × scale is the pressure by the calibration"
    )
    calibration: str = field(
        "", "facts.calibration", "name and date of the estimator's calibration, or empty"
    )
    data: bytes = field(
        "",
        "data.astype('<u2', copy=False).tobytes()",
        "rows × cols little-endian uint16, row by row",
    )

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 1 or len(self.data) != 2 * self.rows * self.cols:
            raise ValueError(
                f"hand/tactile: {len(self.data)} bytes are no {self.rows} × {self.cols} uint16 grid"
            )

    @property
    def counts(self) -> NDArray[np.uint16]:
        """The data [rows, cols], read-only."""
        return np.frombuffer(self.data, dtype="<u2").reshape(self.rows, self.cols)

    def pressure(self) -> NDArray[np.float64]:
        """Counts times the scale [Pa], [rows, cols]."""
        return self.counts.astype(np.float64) * self.scale


@topic(
    EVENT,
    "What happened: modes, faults, warnings; late subscribers get the last 50 again.",
    "seq, wall, t, level, kind, text",
)
@record
class Event(_Announcement):
    """One ``hand/event``."""

    level: str = field("", "level", "info, warning or error")
    kind: str = field("", "kind", "what it is about: mode, fault, servos, …")
    text: str = field("", "text", "one line for a person")


@record
class Spread:
    """One of the loop's times in ``hand/stats``."""

    p50: float = field("s", "spreads['{time}'].p50", "median")
    p99: float = field("s", "spreads['{time}'].p99", "99 % are below")
    p999: float = field("s", "spreads['{time}'].p999", "99.9 % are below")
    max: float = field("s", "spreads['{time}'].max", "longest")


@record
class Rates:
    """How often things have happened over the last second, in ``hand/stats``."""

    tick: float = field("Hz", "rates.tick", "ticks")
    left: float = field("Hz", "rates.left", "tactile frames that came from the left sensor")
    right: float = field("Hz", "rates.right", "tactile frames that came from the right sensor")
    state: float = field("Hz", "rates.state", "states that went out")
    tactile: float = field("Hz", "rates.tactile", "tactile frames that went out")


@topic(
    STATS,
    "Once a second, how the loop keeps its time.",
    "state, period, rates, statistics, step=1",
    **_TICK,
    spreads="statistics.spreads()",
)
@record
class LoopStatistics(_TickMessage):
    """One ``hand/stats``."""

    ticks: int = field("", "statistics.ticks", "since the start, as all of this but the rates")
    overruns: int = field("", "state.timing.overruns", "ticks whose work outlasted the period")
    period_s: float = field("s", "period", "the tick's period")
    wake: Spread = part("a tick's start after its deadline: ", time="wake")
    compute: Spread = part("all of a tick's work: ", time="compute")
    bus: Spread = part("reading and writing the servos: ", time="bus")
    publish: Spread = part("publishing: ", time="publish")
    rates: Rates = part("over the last second: ")


@topic(
    SETTINGS,
    "Once, and again for whoever subscribes later: what this hand is.",
    "seq, wall, t, facts",
)
@record
class HandSettings(_Announcement):
    """One ``hand/settings``."""

    version: str = field("", "facts.version", "of softfinger")
    settings: str = field("", "facts.settings", "all settings, as JSON")
    calibration_left: str = field(
        "", "facts.calibration_left", "the left sensor's calibration as JSON, or empty"
    )
    calibration_right: str = field("", "facts.calibration_right", "the right sensor's")
    table_left: str = field(
        "", "facts.table_left", "the left tip's contact table: form, tolerance, certificate"
    )
    table_right: str = field("", "facts.table_right", "the right tip's")


@topic(
    COMMAND,
    "Each command that was answered, by whomever; `status` is left out.",
    "seq, wall, t, tick, request, error",
)
@record
class AnsweredCommand(_Announcement):
    """One ``hand/command``."""

    tick: int = field("", "tick", "seq of the tick at which it was answered")
    command: str = field("", "str(request.get('command', ''))", "its name")
    client: str = field(
        "", "str(request.get('client', ''))", "who sent it, empty for all who give no name"
    )
    request: str = field("", "json.dumps(request, default=str)", "all of it, as JSON")
    ok: bool = field("", "not error", "carried out")
    error: str = field("", "error", "why it was refused, empty when it was carried out")


@record
class InputReading:
    """The servos' reading in ``hand/input``."""

    seq: int = field("", "reading.seq", "readings of the servos")
    t: float = field("s", "reading.t", "when the last good one was taken; −∞ before it")
    valid: bool = field("", "reading.valid", "this tick's is good")
    alert: int = field("", "reading.alert", "bit i: servo of finger i reports a hardware error")
    error: str = field("", "state.read_error", "what the bus failed with, or empty")
    lost: int = field("", "reading.lost", "bit i: servo of finger i holds none of the last goals")
    frozen: int = field("", "reading.frozen", "bit i: servo of finger i measures nothing new")


@record
class InputFinger:
    """One finger in ``hand/input``."""

    q: float = field("rad", "reading.q[{i}]", "joint angle")
    dq: float = field("rad/s", "reading.dq[{i}]", "joint velocity")
    current: float = field("A", "reading.current[{i}]", "motor current")
    hardware: int = field(
        "", "reading.hardware[{i}]", "the servo's hardware error bits, 0 if not known"
    )
    temperature: float = field(*_TEMPERATURE)
    voltage: float = field(*_VOLTAGE)
    frame_seq: int = field(
        "", "frame{i}.seq if frame{i} else 0", "newest tactile frame, 0 before the first"
    )
    frame_t: float = field(
        "s", "frame{i}.t_sample if frame{i} else 0.0", "when it was scanned, by the daemon's clock"
    )
    frame_arrival: float = field(
        "s", "frame{i}.t_arrival if frame{i} else 0.0", "when it was complete here"
    )
    frame_valid: bool = field(
        "", "frame{i} is not None and frame{i}.valid", "false: the board is gone"
    )


@topic(
    INPUT,
    "All that a tick took in, every tick: what `replay --recompute` starts from.",
    "state, frames",
    **_TICK,
    reading="state.reading",
    frame0="frames[0]",
    frame1="frames[1]",
)
@record
class TickInput:
    """One ``hand/input``."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    timestamp: float = field(*_UNIX)
    mono_ns: int = field(*_MONO)
    t: float = field("s", "t", "the same, with all its digits")
    late_in_row: int = field("", "state.timing.late_in_row", "consecutive overruns")
    busy_s: float = field(
        "s", "state.timing.busy_s", "how long this machine has just kept the loop from a tick, or 0"
    )
    reading: InputReading = part()
    left: InputFinger = part("left finger: ", i=0)
    right: InputFinger = part("right finger: ", i=1)
    write_error: str = field(
        "", "state.write_error", "what the bus failed with when written to, or empty"
    )
    torque_off: bool = field(
        "", "state.torque_off", "the servos confirmed at this tick that torque is off"
    )


@record
class TrueFinger:
    """One finger in ``hand/truth``."""

    d: float = field("m", "float(truth.d[{i}])", "maximum displacement, negative: a gap")
    theta: float = field("rad", "float(truth.theta[{i}])", "the object's angle in the tip's frame")
    force: float = field("N", "float(truth.force[{i}])", "on the tip's base")


@record
class TrueObject:
    """The object in ``hand/truth``."""

    x: float = field("m", "float(pose[0])", "the object's centre in the hand's frame")
    y: float = field("m", "float(pose[1])", "and along y")
    angle: float = field("rad", "float(pose[2])", "the object's angle in the hand's frame")


@topic(
    TRUTH,
    "A simulated hand's own knowledge, with each state. No real hand has it.",
    "state, truth, step=1",
    **_TICK,
    pose="truth.object_pose",
)
@record
class TrueState(_TickMessage):
    """One ``hand/truth``."""

    left: TrueFinger = part("left finger: ", i=0)
    right: TrueFinger = part("right finger: ", i=1)
    object: TrueObject = part()
