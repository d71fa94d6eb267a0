"""Schema of the stream: the only declaration of all topics and fields.

A topic is a record. Each of its fields has a unit, a meaning and a source. Its value is computed by
a function of the source, or is the attribute of the same name. The packers (`wire.publisher`), the
records that clients read (`client.stream`), the page ``STREAM.md`` and the JSON schemas of
recordings (`wire.schema_docs`) are derived from these declarations.

New versions may add fields, but never remove any. A float is always sent as a float. SI units.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import (
    FINGERS,
    Frame,
    HandFacts,
    ObjectPose,
    Parts,
    Reading,
    SensorFacts,
    State,
    TimeSpread,
    Truth,
)
from softfinger.daemon.wire.fields import TOPICS as TOPICS
from softfinger.daemon.wire.fields import FieldSource, record, topic
from softfinger.daemon.wire.fields import fields_of as fields_of
from softfinger.kinematics.estimation.invalid import Invalid

SCHEMA = 1
STATE = b"hand/state"
TACTILE = b"hand/tactile"
EVENT = b"hand/event"
STATS = b"hand/stats"
SETTINGS = b"hand/settings"
COMMAND = b"hand/command"
INPUT = b"hand/input"
TRUTH = b"hand/truth"

NO_FRAME = Frame(0, t_sample=0.0, t_arrival=0.0, valid=False, data=np.zeros((0, 0), np.uint16))

# Common first fields of several topics.
_SCHEMA = "", "number of this schema; changes only when a field's meaning does"
_SEQ = "", "counts up: ticks, frames, events"
_STEP = "", "one of so many is sent"
_UNIX = "s", "Unix time"
_MONO = "ns", "the daemon's monotonic clock at the tick"
_TEMPERATURE = "°C", "of the servo, 0 while not known"
_VOLTAGE = "V", "of the servo's supply, 0 while not known"


def _ns(t: float) -> int:
    return int(t * 1e9)


# Fields that several sources have in common are declared for one of them.
_tick = FieldSource["StateSource"]()
_state = _tick.of(lambda m: m.state)
_timing = _state.of(lambda s: s.timing)
_news = FieldSource["EventSource"]()


@record
class _TickMessage:
    """Message that is sent every n-th tick."""

    schema: int = _state(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _state(*_SEQ)
    seq_step: int = _tick(*_STEP, lambda m: m.step)
    timestamp: float = _state(*_UNIX, lambda s: s.wall)
    mono_ns: int = _state(*_MONO, lambda s: _ns(s.t))


@record
class _Announcement:
    """Message that is sent when an event occurs."""

    schema: int = _news(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _news(*_SEQ)
    again: bool = _news(
        "", "repeated for a late subscriber, with its first seq and times", lambda _: False
    )
    timestamp: float = _news(*_UNIX, lambda m: m.wall)
    mono_ns: int = _news("ns", "the daemon's monotonic clock", lambda m: _ns(m.t))


class StateSource(NamedTuple):
    """Source of a ``hand/state``."""

    state: State
    scene: Parts
    step: int = 1


class _Finger(NamedTuple):
    state: State
    scene: Parts
    i: int


_finger = FieldSource[_Finger]()
_contact = _finger.of(lambda f: f.state.contacts[f.i])
_heat = _finger.of(lambda f: f.state.heat[f.i])
_pose = FieldSource[ObjectPose]()
_goal = _state.of(lambda s: s.goal)


def _invalid(f: _Finger) -> Invalid:
    scene, state = f.scene, f.state
    if not scene.fingers[f.i]:
        return Invalid.ABSENT
    if scene.servos and not state.reading.valid:
        return Invalid.SERVO
    return state.contacts[f.i].invalid if scene.sensors else Invalid.NONE


def _frame_age(f: _Finger) -> float:
    contact = f.state.contacts[f.i]
    return f.state.t - contact.t if contact.seq else 0.0


@record
class FingerState:
    """One finger in ``hand/state``."""

    valid: bool = _finger(
        "",
        "in the scene, with fresh and sound data from its servo and sensor",
        lambda f: not _invalid(f),
    )
    q: float = _finger("rad", "joint angle, positive closes", lambda f: f.state.reading.q[f.i])
    dq: float = _finger("rad/s", "joint velocity", lambda f: f.state.reading.dq[f.i])
    current: float = _finger(
        "A", "motor current, positive closes", lambda f: f.state.reading.current[f.i]
    )
    temperature: float = _finger(*_TEMPERATURE, lambda f: f.state.reading.temperature[f.i])
    voltage: float = _finger(*_VOLTAGE, lambda f: f.state.reading.voltage[f.i])
    goal_q: float = _finger("rad", "goal angle", lambda f: f.state.goal.q[f.i])
    goal_current: float = _finger(
        "A", "bound on the current's magnitude", lambda f: f.state.goal.current[f.i]
    )
    d: float = _contact("m", "maximum displacement of the tip")
    theta: float = _contact("rad", "the object's angle in the tip's frame, in the hand's plane")
    tilt_y: float = _contact("rad", "and across the plane")
    force: float = _contact(
        "N", "elastic force, modulus_scale · F(d, total tilt of theta and tilt_y) by the table"
    )
    energy: float = _contact("J", "elastic potential energy, modulus_scale · U(d, total tilt)")
    d_std: float = _contact(
        "m", "standard deviation of d; without contact the d that could hide from the sensor"
    )
    theta_std: float = _contact("rad", "standard deviation of theta")
    force_std: float = _contact("N", "standard deviation of force, with that of the tip's law")
    shear_x: float = _contact(
        "N",
        "force along a solid tip's face, in the hand's plane, by the newest frame; 0 with springs",
    )
    shear_y: float = _contact("N", "and across the plane")
    gain: float = _contact("", "measured over modelled pressure")
    modulus_scale: float = _contact("", "of the tip's modulus over the settings', as grips tell it")
    modulus_scale_std: float = _contact("", "its standard deviation")
    sensor_gain: float = _contact("", "of the sensor: gain over modulus_scale")
    sensor_gain_std: float = _contact("", "its standard deviation")
    torque_scale: float = _contact("", "of the joint's torque constant over the settings'")
    torque_scale_std: float = _contact("", "its standard deviation")
    nis_angle: float = _contact(
        "", "consistency of the sensor's angle: normalised innovation squared, averaged; about 1"
    )
    nis_footprint: float = _contact("", "likewise of d by the footprint")
    nis_amplitude: float = _contact("", "likewise of the pressure's amplitude")
    misfit: bool = _contact("", "the frame fits no contact of the model: d, theta may be biased")
    contact: bool = _contact("", "something touches the tip")
    frame_seq: int = _contact(
        "", "the estimate's tactile frame, 0 before the first", lambda c: c.seq
    )
    frame_age_s: float = _finger("s", "age of that frame's sample", _frame_age)
    invalid: str = _finger("", "why it is not valid, empty when it is", lambda f: _invalid(f).text)
    winding: float = _heat("°C", "temperature of the motor's winding, by the thermal model")
    winding_std: float = _heat("°C", "its standard deviation")
    case: float = _heat("°C", "temperature without the reading's steps, by the thermal model")
    case_std: float = _heat("°C", "its standard deviation")
    time_to_limit: float = _heat(
        "s", "until the servo is at safety.temperature_max with this current; 3600: an hour or more"
    )


@record
class ObjectState:
    """The object in ``hand/state``, from the two contacts."""

    valid: bool = _pose("", "both contacts give the object's pose")
    angle: float = _pose(
        "rad",
        "the object's angle in the hand's frame: of its faces' bisector, or of the line between "
        "the contacts of a disc",
    )
    width: float = _pose("m", "the object's width between the tips")
    nis_torque: float = _pose(
        "", "consistency of joint torques and forces: normalised innovation squared, averaged"
    )
    nis_balance: float = _pose("", "likewise of the balance between both tips")


@topic(
    STATE,
    "What the hand is, does and feels, every n-th tick (`stream.state_rate`).",
    StateSource,
)
@record
class HandState(_TickMessage):
    """One ``hand/state``."""

    mode: str = _state("", "disarmed, armed, moving, grasping, holding, rotating, releasing, fault")
    fault: str = _state("", "reason of the latched fault, empty when none")
    fault_name: str = _state("", "its name in `softfinger.daemon.safety.limits`, empty when none")
    torque: bool = _state("", "torque is on, or not known to be off")
    tick_s: float = _timing("s", "from the last tick's start to this one's")
    compute_s: float = _timing("s", "work of the last tick")
    wake_late_s: float = _timing("s", "this tick's start after its deadline")
    overruns: int = _timing("", "ticks whose work outlasted the period")
    behind_s: float = _timing(
        "s", "how long a hand simulated in the daemon has waited for a busy machine since the start"
    )
    goal_force: float = _goal(
        "N",
        "mean tip force of the grip: as commanded, or raised against slip; NaN without a grip",
        lambda g: g.force,
    )
    goal_angle: float = _goal("rad", "object angle of the grip; NaN without one", lambda g: g.angle)
    left: FingerState = _tick.part("left finger: ", lambda m: _Finger(m.state, m.scene, 0))
    right: FingerState = _tick.part("right finger: ", lambda m: _Finger(m.state, m.scene, 1))
    object: ObjectState = _state.part("", lambda s: s.object)

    def finger(self, name: str) -> FingerState:
        """Return ``left`` or ``right`` by its name. Raises ValueError for other names."""
        if name not in FINGERS:
            raise ValueError(f"found finger {name!r}, expected one of {', '.join(FINGERS)}")
        return self.left if name == FINGERS[0] else self.right


class TactileSource(NamedTuple):
    """Source of a ``hand/tactile``."""

    frame: Frame
    data: NDArray[np.uint16]  # as published [rows, cols]
    finger: int
    facts: SensorFacts
    wall: float
    step: int = 1
    number: int = 0


_tactile = FieldSource[TactileSource]()
_frame = _tactile.of(lambda m: m.frame)
_facts = _tactile.of(lambda m: m.facts)


@topic(
    TACTILE,
    "The grids' raw frames (`stream.tactile_rate`), one finger a message.",
    TactileSource,
)
@record
class TactileFrame:
    """One ``hand/tactile``. Raises ValueError if its data is not a grid of rows × cols."""

    schema: int = _tactile(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _frame(*_SEQ)
    seq_step: int = _tactile(*_STEP, lambda m: m.step)
    number: int = _tactile("", "counts this sensor's messages: a gap is a loss on the way")
    timestamp: float = _tactile(*_UNIX, lambda m: m.wall)
    mono_ns: int = _frame(
        "ns", "the daemon's monotonic clock at the board's scan", lambda f: _ns(f.t_sample)
    )
    delay_s: float = _frame(
        "s", "from the scan until the frame had come", lambda f: f.t_arrival - f.t_sample
    )
    valid: bool = _frame("", "false: the board is gone, this is its last frame again")
    finger: str = _tactile("", "left or right", lambda m: FINGERS[m.finger])
    rows: int = _tactile("", "cells along y", lambda m: m.data.shape[0])
    cols: int = _tactile("", "cells along x", lambda m: m.data.shape[1])
    pitch: float = _facts("m", "from column to column")
    pitch_y: float = _facts("m", "from row to row")
    centre_x: float = _facts("m", "the tip's centre off the grid's, along x")
    centre_y: float = _facts("m", "and along y")
    rotation: float = _facts("rad", "of the sensor's axes against the finger's")
    unit: str = _facts("", "`count`: as the board sent it; `Pa`: as it was estimated")
    scale: float = _facts("Pa", "one step of the data, exact for linear sensors")
    calibrated: bool = _facts("", "data × scale is the pressure by the calibration")
    calibration: str = _facts("", "name and date of the estimator's calibration, or empty")
    data: bytes = _tactile(
        "",
        "rows × cols little-endian uint16, row by row",
        lambda m: m.data.astype("<u2", copy=False).tobytes(),
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
        """Return counts times scale [Pa], shape [rows, cols]."""
        return self.counts.astype(np.float64) * self.scale


class EventSource(NamedTuple):
    """Source of a ``hand/event``."""

    seq: int
    wall: float
    t: float
    level: str
    kind: str
    text: str


_event = FieldSource[EventSource]()


@topic(
    EVENT,
    "What happened: modes, faults, warnings; late subscribers get the last 50 again.",
    EventSource,
)
@record
class Event(_Announcement):
    """One ``hand/event``."""

    level: str = _event("", "info, warning or error")
    kind: str = _event("", "what it is about: mode, fault, servos, …")
    text: str = _event("", "one line for a person")


_times = FieldSource[TimeSpread]()
_rates = FieldSource["Rates"]()


@record
class Spread:
    """One of the loop's times in ``hand/stats``."""

    p50: float = _times("s", "median")
    p99: float = _times("s", "99 % are below")
    p999: float = _times("s", "99.9 % are below")
    max: float = _times("s", "longest")


@record
class Rates:
    """Rates of what happened over the last second, in ``hand/stats``."""

    tick: float = _rates("Hz", "ticks")
    left: float = _rates("Hz", "tactile frames that came from the left sensor")
    right: float = _rates("Hz", "tactile frames that came from the right sensor")
    state: float = _rates("Hz", "states that went out")
    tactile: float = _rates("Hz", "tactile frames that went out")


class StatsSource(NamedTuple):
    """Source of a ``hand/stats``."""

    state: State
    period: float
    rates: Rates
    ticks: int
    spreads: Mapping[str, TimeSpread]
    step: int = 1


_stats = FieldSource[StatsSource]()


@topic(STATS, "Once a second, how the loop keeps its time.", StatsSource)
@record
class LoopStatistics(_TickMessage):
    """One ``hand/stats``."""

    ticks: int = _stats("", "since the start, as all of this but the rates")
    overruns: int = _timing("", "ticks whose work outlasted the period")
    period_s: float = _stats("s", "the tick's period", lambda m: m.period)
    wake: Spread = _stats.part("a tick's start after its deadline: ", lambda m: m.spreads["wake"])
    compute: Spread = _stats.part("all of a tick's work: ", lambda m: m.spreads["compute"])
    bus: Spread = _stats.part("reading and writing the servos: ", lambda m: m.spreads["bus"])
    publish: Spread = _stats.part("publishing: ", lambda m: m.spreads["publish"])
    rates: Rates = _stats.part("over the last second: ", lambda m: m.rates)


class SettingsSource(NamedTuple):
    """Source of a ``hand/settings``."""

    seq: int
    wall: float
    t: float
    facts: HandFacts


_hand_facts = FieldSource[SettingsSource]().of(lambda m: m.facts)


@topic(SETTINGS, "Once, and again for late subscribers: what this hand is.", SettingsSource)
@record
class HandSettings(_Announcement):
    """One ``hand/settings``."""

    version: str = _hand_facts("", "of softfinger")
    settings: str = _hand_facts("", "all settings, as JSON")
    calibration_left: str = _hand_facts("", "the left sensor's calibration as JSON, or empty")
    calibration_right: str = _hand_facts("", "the right sensor's")
    table_left: str = _hand_facts(
        "", "the left tip's contact table: form, tolerance, certificate (bound of its error)"
    )
    table_right: str = _hand_facts("", "the right tip's")


class CommandSource(NamedTuple):
    """Source of a ``hand/command``."""

    seq: int
    wall: float
    t: float
    tick: int
    request: Mapping[str, Any]
    error: str


_command = FieldSource[CommandSource]()


@topic(COMMAND, "Each command that was answered, by whomever; `status` is left out.", CommandSource)
@record
class AnsweredCommand(_Announcement):
    """One ``hand/command``."""

    tick: int = _command("", "seq of the tick at which it was answered")
    command: str = _command("", "its name", lambda m: str(m.request.get("command", "")))
    client: str = _command(
        "",
        "who sent it, empty for all who give no name",
        lambda m: str(m.request.get("client", "")),
    )
    request: str = _command("", "all of it, as JSON", lambda m: json.dumps(m.request, default=str))
    ok: bool = _command("", "carried out", lambda m: not m.error)
    error: str = _command("", "why it was refused, empty when it was carried out")


class InputSource(NamedTuple):
    """Source of a ``hand/input``."""

    state: State
    frames: Sequence[Frame | None]


class _InputFinger(NamedTuple):
    reading: Reading
    i: int
    frame: Frame


_input = FieldSource[InputSource]()
_read = FieldSource[State]()
_reading = _read.of(lambda s: s.reading)
_taken = FieldSource[_InputFinger]()
_newest = _taken.of(lambda f: f.frame)


def _input_finger(m: InputSource, i: int) -> _InputFinger:
    return _InputFinger(m.state.reading, i, m.frames[i] or NO_FRAME)


@record
class InputReading:
    """The servos' reading in ``hand/input``."""

    seq: int = _reading("", "readings of the servos")
    t: float = _reading("s", "when the last good one was taken; −∞ before it")
    valid: bool = _reading("", "this tick's is good")
    alert: int = _reading("", "bit i: servo of finger i reports a hardware error")
    error: str = _read("", "what the bus failed with, or empty", lambda s: s.read_error)
    lost: int = _reading("", "bit i: servo of finger i holds none of the last goals")
    frozen: int = _reading("", "bit i: servo of finger i measures nothing new")


@record
class InputFinger:
    """One finger in ``hand/input``."""

    q: float = _taken("rad", "joint angle", lambda f: f.reading.q[f.i])
    dq: float = _taken("rad/s", "joint velocity", lambda f: f.reading.dq[f.i])
    current: float = _taken("A", "motor current", lambda f: f.reading.current[f.i])
    hardware: int = _taken(
        "", "the servo's hardware error bits, 0 if not known", lambda f: f.reading.hardware[f.i]
    )
    temperature: float = _taken(*_TEMPERATURE, lambda f: f.reading.temperature[f.i])
    voltage: float = _taken(*_VOLTAGE, lambda f: f.reading.voltage[f.i])
    frame_seq: int = _newest("", "newest tactile frame, 0 before the first", lambda f: f.seq)
    frame_t: float = _newest(
        "s", "when it was scanned, by the daemon's clock", lambda f: f.t_sample
    )
    frame_arrival: float = _newest("s", "when it was complete here", lambda f: f.t_arrival)
    frame_valid: bool = _newest("", "false: the board is gone", lambda f: f.valid)


@topic(
    INPUT,
    "All that a tick took in, every tick: what `replay --recompute` starts from.",
    InputSource,
)
@record
class TickInput:
    """One ``hand/input``."""

    schema: int = _state(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _state(*_SEQ)
    timestamp: float = _state(*_UNIX, lambda s: s.wall)
    mono_ns: int = _state(*_MONO, lambda s: _ns(s.t))
    t: float = _state("s", "the same, with all its digits")
    late_in_row: int = _timing("", "consecutive overruns")
    busy_s: float = _timing("s", "how long a busy machine has just held up the loop")
    reading: InputReading = _input.part("", lambda m: m.state)
    left: InputFinger = _input.part("left finger: ", lambda m: _input_finger(m, 0))
    right: InputFinger = _input.part("right finger: ", lambda m: _input_finger(m, 1))
    write_error: str = _state("", "what the bus failed with when written to, or empty")
    torque_off: bool = _state("", "the servos confirmed at this tick that torque is off")


class TruthSource(NamedTuple):
    """Source of a ``hand/truth``."""

    state: State
    truth: Truth
    step: int = 1


class _TruthOf(NamedTuple):
    truth: Truth
    i: int


_truth = FieldSource[TruthSource]()
_true_finger = FieldSource[_TruthOf]()
_true_pose = FieldSource[NDArray[np.float64]]()


@record
class TrueFinger:
    """One finger in ``hand/truth``."""

    d: float = _true_finger(
        "m", "maximum displacement, negative: a gap", lambda f: float(f.truth.d[f.i])
    )
    theta: float = _true_finger(
        "rad", "the object's angle in the tip's frame", lambda f: float(f.truth.theta[f.i])
    )
    force: float = _true_finger("N", "on the tip's base", lambda f: float(f.truth.force[f.i]))


@record
class TrueObject:
    """The object in ``hand/truth``."""

    x: float = _true_pose("m", "the object's centre in the hand's frame", lambda p: float(p[0]))
    y: float = _true_pose("m", "and along y", lambda p: float(p[1]))
    angle: float = _true_pose(
        "rad", "the object's angle in the hand's frame", lambda p: float(p[2])
    )


@topic(
    TRUTH, "A simulated hand's own knowledge, with each state. No real hand has it.", TruthSource
)
@record
class TrueState(_TickMessage):
    """One ``hand/truth``, by names of its own: a plot of all topics keeps them apart."""

    true_left: TrueFinger = _truth.part("left finger: ", lambda m: _TruthOf(m.truth, 0))
    true_right: TrueFinger = _truth.part("right finger: ", lambda m: _TruthOf(m.truth, 1))
    true_object: TrueObject = _truth.part("", lambda m: m.truth.object_pose)
