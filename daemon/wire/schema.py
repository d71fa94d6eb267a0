"""Define the stream schema, which declares all topics and fields.

Each topic is a record. Each field has a unit, a meaning and a source. The value of a field is a
function of the source or, by default, the source attribute of the same name. The packers
(`wire.publisher`) and the clients' records (`client.stream`) use these declarations. The
``STREAM.md`` page and the JSON Schemas of recordings (`wire.schema_docs`) are generated from the
declarations.

New versions may add fields but never remove fields. A float is always sent as a float. Values are
in SI units.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import (
    FINGERS,
    Frame,
    HandInfo,
    ObjectPose,
    Reading,
    SceneParts,
    SensorInfo,
    State,
    TimeSpread,
    Truth,
)
from softfinger.daemon.wire import record_text
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

# Fields at the start of several topics.
_SCHEMA = "", "schema version; changes only if the meaning of a field changes"
_SEQ = "", "sequence number of the tick, frame or event"
_STEP = "", "decimation factor n: every n-th message is sent"
_UNIX = "s", "Unix time"
_MONO = "ns", "time of the tick on the daemon's monotonic clock"
_TEMPERATURE = "°C", "temperature of the servo, 0 if unknown"
_VOLTAGE = "V", "supply voltage of the servo, 0 if unknown"


def _ns(t: float) -> int:
    return int(t * 1e9)


# If several sources share a field, only one of the sources declares the field.
_tick = FieldSource["StateSource"]()
_state = _tick.of(lambda m: m.state)
_timing = _state.of(lambda s: s.timing)
_news = FieldSource["EventSource"]()


@record
class _TickMessage:
    """Message that is sent on every n-th tick."""

    schema: int = _state(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _state(*_SEQ)
    seq_step: int = _tick(*_STEP, lambda m: m.step)
    timestamp: float = _state(*_UNIX, lambda s: s.wall)
    mono_ns: int = _state(*_MONO, lambda s: _ns(s.t))


@record
class _Announcement:
    """Message sent when an event occurs."""

    schema: int = _news(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _news(*_SEQ)
    again: bool = _news(
        "",
        "true if the message is repeated for a new subscriber, with the original seq and times",
        lambda _: False,
    )
    timestamp: float = _news(*_UNIX, lambda m: m.wall)
    mono_ns: int = _news("ns", "time on the daemon's monotonic clock", lambda m: _ns(m.t))


class StateSource(NamedTuple):
    """Source of a ``hand/state`` message."""

    state: State
    scene: SceneParts
    step: int = 1


class _Finger(NamedTuple):
    state: State
    scene: SceneParts
    i: int


_finger = FieldSource[_Finger]()
_contact = _finger.of(lambda f: f.state.contacts[f.i])
_heat = _finger.of(lambda f: f.state.heat[f.i])
_pose = FieldSource[ObjectPose]()
_goal = _state.of(lambda s: s.goal)


def _invalid(f: _Finger) -> Invalid:
    scene, state = f.scene, f.state
    if not scene.fingers[f.i]:
        return Invalid.NOT_IN_SCENE
    if scene.has_servos and not state.reading.valid:
        return Invalid.SERVO_NOT_READ
    return state.contacts[f.i].invalid if scene.has_sensors else Invalid.NONE


def _frame_age(f: _Finger) -> float:
    contact = f.state.contacts[f.i]
    return f.state.t - contact.t if contact.seq else 0.0


@record
class FingerState:
    """One finger in ``hand/state``."""

    valid: bool = _finger(
        "",
        "the finger is in the scene, and its servo and sensor deliver valid, recent data",
        lambda f: not _invalid(f),
    )
    q: float = _finger(
        "rad", "joint angle, positive when closing", lambda f: f.state.reading.q[f.i]
    )
    dq: float = _finger("rad/s", "joint velocity", lambda f: f.state.reading.dq[f.i])
    current: float = _finger(
        "A", "motor current, positive when closing", lambda f: f.state.reading.current[f.i]
    )
    temperature: float = _finger(*_TEMPERATURE, lambda f: f.state.reading.temperature[f.i])
    voltage: float = _finger(*_VOLTAGE, lambda f: f.state.reading.voltage[f.i])
    goal_q: float = _finger("rad", "goal angle", lambda f: f.state.goal.q[f.i])
    goal_current: float = _finger(
        "A", "maximum magnitude of the motor current", lambda f: f.state.goal.current[f.i]
    )
    d: float = _contact("m", "maximum displacement of the tip")
    theta: float = _contact("rad", "tilt: object angle relative to the tip, in the hand's plane")
    tilt_y: float = _contact("rad", "tilt out of the hand's plane")
    force: float = _contact(
        "N", "elastic force: modulus_scale · F(d, total tilt of theta and tilt_y) from the table"
    )
    energy: float = _contact("J", "elastic potential energy, modulus_scale · U(d, total tilt)")
    d_std: float = _contact(
        "m", "standard deviation of d; without contact, the smallest detectable d"
    )
    theta_std: float = _contact("rad", "standard deviation of theta")
    force_std: float = _contact(
        "N", "standard deviation of force, including the error of the contact law"
    )
    shear_x: float = _contact(
        "N",
        "shear force of a solid tip in the hand's plane, from the newest frame; 0 with springs",
    )
    shear_y: float = _contact(
        "N", "shear force of a solid tip normal to the hand's plane; 0 with springs"
    )
    gain: float = _contact("", "ratio of measured to modelled pressure")
    modulus_scale: float = _contact(
        "", "tip modulus estimated during grips, divided by the configured modulus"
    )
    modulus_scale_std: float = _contact("", "standard deviation of modulus_scale")
    sensor_gain: float = _contact("", "gain of the sensor, equal to gain divided by modulus_scale")
    sensor_gain_std: float = _contact("", "standard deviation of sensor_gain")
    torque_scale: float = _contact(
        "", "configured torque constant of the joint divided by the estimated torque constant"
    )
    torque_scale_std: float = _contact("", "standard deviation of torque_scale")
    nis_angle: float = _contact(
        "",
        "consistency of the angle channel: mean normalised innovation squared, which should be 1",
    )
    nis_footprint: float = _contact("", "consistency of the footprint channel (d)")
    nis_amplitude: float = _contact("", "consistency of the amplitude channel (pressure)")
    misfit: bool = _contact(
        "", "the frame does not match the contact model; d and theta may be biased"
    )
    contact: bool = _contact("", "the tip is in contact")
    frame_seq: int = _contact(
        "",
        "sequence number of the tactile frame used for the estimate, 0 before the first frame",
        lambda c: c.seq,
    )
    frame_age_s: float = _finger("s", "time since the scan of the frame `frame_seq`", _frame_age)
    invalid: str = _finger(
        "", "reason why the finger is not valid, or empty", lambda f: _invalid(f).text
    )
    winding: float = _heat("°C", "temperature of the motor winding, from the thermal model")
    winding_std: float = _heat("°C", "standard deviation of winding")
    case: float = _heat(
        "°C",
        "temperature of the case, from the thermal model, without quantisation",
    )
    case_std: float = _heat("°C", "standard deviation of case")
    time_to_limit: float = _heat(
        "s",
        "time until safety.temperature_max is reached at the current motor current; 3600 "
        "means at least one hour",
    )

    def __repr__(self) -> str:
        return f"FingerState: {record_text.finger_text(self)}"


@record
class ObjectState:
    """The object in ``hand/state``, estimated from both contacts."""

    valid: bool = _pose("", "both contacts are valid and determine the pose")
    angle: float = _pose(
        "rad",
        "rotation of the object in the hand's frame, 0 if it is upright: mean rotation of both "
        "faces, or rotation of the line between the two contacts of a disc",
    )
    width: float = _pose("m", "width of the object between the tips")
    nis_torque: float = _pose(
        "",
        "consistency of the torque channel: mean normalised innovation squared, which should be 1",
    )
    nis_balance: float = _pose(
        "", "consistency of the balance channel (difference between the forces of both tips)"
    )

    def __repr__(self) -> str:
        return f"ObjectState: {record_text.object_text(self)}"


@topic(
    STATE,
    "The state of the hand, every n-th tick (`stream.state_rate`).",
    StateSource,
)
class HandState(_TickMessage):
    """One ``hand/state`` message."""

    mode: str = _state("", "disarmed, armed, moving, grasping, holding, rotating, releasing, fault")
    fault: str = _state("", "text of the latched fault, or empty")
    fault_name: str = _state("", "name of the fault in `softfinger.daemon.safety.limits`, or empty")
    torque: bool = _state("", "torque is on, or torque off is not confirmed")
    tick_s: float = _timing("s", "time from the start of the last tick to the start of this tick")
    compute_s: float = _timing("s", "computing time of the last tick")
    wake_late_s: float = _timing("s", "delay of the start of this tick after its deadline")
    overruns: int = _timing("", "number of ticks that took longer than the period")
    behind_s: float = _timing(
        "s",
        "total time by which the simulation in the daemon has paused because the machine was busy",
    )
    goal_force: float = _goal(
        "N",
        "target of the mean tip force, including any increase that counteracts slip; NaN "
        "without a grip",
        lambda g: g.force,
    )
    goal_angle: float = _goal(
        "rad", "target of the object angle; NaN unless the angle is controlled", lambda g: g.angle
    )
    left: FingerState = _tick.part("left finger: ", lambda m: _Finger(m.state, m.scene, 0))
    right: FingerState = _tick.part("right finger: ", lambda m: _Finger(m.state, m.scene, 1))
    object: ObjectState = _state.part("", lambda s: s.object)

    def __repr__(self) -> str:
        return f"HandState: {', '.join(record_text.state_parts(self))}"

    def _repr_html_(self) -> str:
        return record_text.state_html(self)

    def finger(self, name: str) -> FingerState:
        """Return the finger named ``left`` or ``right``.

        Raises ValueError if no finger has this name.
        """
        if name not in FINGERS:
            raise ValueError(f"found finger {name!r}, expected one of {', '.join(FINGERS)}")
        return self.left if name == FINGERS[0] else self.right


class TactileSource(NamedTuple):
    """Source of a ``hand/tactile`` message."""

    frame: Frame
    data: NDArray[np.uint16]  # published counts [rows, cols]
    finger: int
    info: SensorInfo
    wall: float
    step: int = 1
    number: int = 0


_tactile = FieldSource[TactileSource]()
_frame = _tactile.of(lambda m: m.frame)
_info = _tactile.of(lambda m: m.info)


@topic(
    TACTILE,
    "Tactile frames (`stream.tactile_rate`), one message per finger.",
    TactileSource,
)
class TactileFrame:
    """One ``hand/tactile`` message. Raises ValueError if the data is not a rows × cols grid."""

    schema: int = _tactile(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _frame(*_SEQ)
    seq_step: int = _tactile(*_STEP, lambda m: m.step)
    number: int = _tactile(
        "", "sequence number of this sensor's messages; a gap means that messages were lost"
    )
    timestamp: float = _tactile(*_UNIX, lambda m: m.wall)
    mono_ns: int = _frame(
        "ns", "time of the board's scan on the daemon's clock", lambda f: _ns(f.t_sample)
    )
    delay_s: float = _frame(
        "s", "time from the scan to the arrival of the frame", lambda f: f.t_arrival - f.t_sample
    )
    valid: bool = _frame("", "false if the board was disconnected after this frame")
    finger: str = _tactile("", "left or right", lambda m: FINGERS[m.finger])
    rows: int = _tactile("", "number of cells along y", lambda m: m.data.shape[0])
    cols: int = _tactile("", "number of cells along x", lambda m: m.data.shape[1])
    pitch: float = _info("m", "distance between the columns")
    pitch_y: float = _info("m", "distance between the rows")
    centre_x: float = _info("m", "x offset of the tip's centre from the grid's centre")
    centre_y: float = _info("m", "y offset of the tip's centre from the grid's centre")
    rotation: float = _info("rad", "rotation of the sensor's axes relative to the finger's axes")
    unit: str = _info("", "`count`: as sent by the board; `Pa`: as used by the estimator")
    scale: float = _info("Pa", "pressure per count in data; exact for linear sensors")
    calibrated: bool = _info("", "data × scale is the calibrated pressure")
    calibration: str = _info("", "name and date of the calibration, or empty")
    data: bytes = _tactile(
        "",
        "rows × cols little-endian uint16, row-major",
        lambda m: m.data.astype("<u2", copy=False).tobytes(),
    )

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 1 or len(self.data) != 2 * self.rows * self.cols:
            raise ValueError(
                f"hand/tactile: found {len(self.data)} bytes, expected a {self.rows} × "
                f"{self.cols} uint16 grid"
            )

    def __repr__(self) -> str:
        return f"TactileFrame: {record_text.frame_text(self)}"

    def _repr_html_(self) -> str:
        return record_text.frame_html(self)

    @property
    def counts(self) -> NDArray[np.uint16]:
        """The frame's data, uint16 [rows, cols], read-only."""
        return np.frombuffer(self.data, dtype="<u2").reshape(self.rows, self.cols)

    @property
    def pressure(self) -> NDArray[np.float64]:
        """Pressure of each cell [Pa] (counts times scale), float64 [rows, cols]."""
        return self.counts.astype(np.float64) * self.scale


class EventSource(NamedTuple):
    """Source of a ``hand/event`` message."""

    seq: int
    wall: float
    t: float
    level: str
    kind: str
    text: str


_event = FieldSource[EventSource]()


@topic(
    EVENT,
    "Events: mode changes, faults and warnings. New subscribers first receive the last 50 events.",
    EventSource,
)
class Event(_Announcement):
    """One ``hand/event`` message."""

    level: str = _event("", "info, warning or error")
    kind: str = _event("", "kind of the event: mode, fault, servos, …")
    text: str = _event("", "one-line message")

    def __repr__(self) -> str:
        return f"Event: {self.level}, {self.kind}: {self.text}"


_times = FieldSource[TimeSpread]()
_rates = FieldSource["Rates"]()


@record
class Spread:
    """Statistics of one loop duration in ``hand/stats``."""

    p50: float = _times("s", "median")
    p99: float = _times("s", "99 % quantile")
    p999: float = _times("s", "99.9 % quantile")
    max: float = _times("s", "maximum")


@record
class Rates:
    """Rates over the last second, in ``hand/stats``; NaN in the first message."""

    tick: float = _rates("Hz", "ticks")
    left: float = _rates("Hz", "tactile frames received from the left sensor")
    right: float = _rates("Hz", "tactile frames received from the right sensor")
    state: float = _rates("Hz", "states published")
    tactile: float = _rates("Hz", "tactile frames published")


class StatsSource(NamedTuple):
    """Source of a ``hand/stats`` message."""

    state: State
    period: float
    rates: Rates
    ticks: int
    spreads: Mapping[str, TimeSpread]
    step: int = 1


_stats = FieldSource[StatsSource]()


@topic(STATS, "Timing of the loop, once a second.", StatsSource)
class LoopStatistics(_TickMessage):
    """One ``hand/stats`` message."""

    ticks: int = _stats(
        "", "number of ticks since startup; all fields except the rates refer to these ticks"
    )
    overruns: int = _timing("", "number of ticks that took longer than the period")
    period_s: float = _stats("s", "period of the ticks", lambda m: m.period)
    wake: Spread = _stats.part("delay of the start of a tick: ", lambda m: m.spreads["wake"])
    compute: Spread = _stats.part("total time of a tick: ", lambda m: m.spreads["compute"])
    bus: Spread = _stats.part("reading and writing the servos: ", lambda m: m.spreads["bus"])
    publish: Spread = _stats.part("publishing: ", lambda m: m.spreads["publish"])
    rates: Rates = _stats.part("in the last second: ", lambda m: m.rates)


class SettingsSource(NamedTuple):
    """Source of a ``hand/settings`` message."""

    seq: int
    wall: float
    t: float
    info: HandInfo


_hand_info = FieldSource[SettingsSource]().of(lambda m: m.info)


@topic(
    SETTINGS,
    "Description of this hand, sent at startup and to each new subscriber.",
    SettingsSource,
)
class HandSettings(_Announcement):
    """One ``hand/settings`` message."""

    version: str = _hand_info("", "version of softfinger")
    settings: str = _hand_info("", "all settings as JSON")
    calibration_left: str = _hand_info("", "calibration of the left sensor as JSON, or empty")
    calibration_right: str = _hand_info("", "calibration of the right sensor as JSON, or empty")
    table_left: str = _hand_info(
        "", "contact table of the left tip: form, tolerance and certificate (error bound)"
    )
    table_right: str = _hand_info("", "contact table of the right tip")


class CommandSource(NamedTuple):
    """Source of a ``hand/command`` message."""

    seq: int
    wall: float
    t: float
    tick: int
    request: Mapping[str, Any]
    error: str


_command = FieldSource[CommandSource]()


@topic(
    COMMAND,
    "Commands from any client or task that were carried out or rejected, except `status`, and "
    "except malformed maps and commands rejected as `busy`, `stopped` or `superseded`.",
    CommandSource,
)
class AnsweredCommand(_Announcement):
    """One ``hand/command`` message."""

    tick: int = _command("", "seq of the tick that replied to the command")
    command: str = _command("", "name of the command", lambda m: str(m.request.get("command", "")))
    client: str = _command(
        "",
        "name of the client, `task` for a task, or empty",
        lambda m: str(m.request.get("client", "")),
    )
    request: str = _command(
        "", "complete request as JSON", lambda m: json.dumps(m.request, default=str)
    )
    ok: bool = _command("", "the command was carried out", lambda m: not m.error)
    error: str = _command("", "reason for the rejection, or empty")


class InputSource(NamedTuple):
    """Source of a ``hand/input`` message."""

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
    """Servo readings in ``hand/input``."""

    seq: int = _reading("", "sequence number of the servo reading")
    t: float = _reading("s", "time of the last valid reading, −∞ before the first reading")
    valid: bool = _reading("", "the reading of this tick is valid")
    alert: int = _reading("", "bit i: the servo of finger i reports a hardware error")
    error: str = _read("", "bus error, or empty", lambda s: s.read_error)
    lost: int = _reading("", "bit i: the servo of finger i has not received the last goals")
    frozen: int = _reading("", "bit i: the servo of finger i repeats outdated readings")


@record
class InputFinger:
    """One finger in ``hand/input``."""

    q: float = _taken("rad", "joint angle", lambda f: f.reading.q[f.i])
    dq: float = _taken("rad/s", "joint velocity", lambda f: f.reading.dq[f.i])
    current: float = _taken("A", "motor current", lambda f: f.reading.current[f.i])
    hardware: int = _taken(
        "", "hardware error bits of the servo, 0 if unknown", lambda f: f.reading.hardware[f.i]
    )
    temperature: float = _taken(*_TEMPERATURE, lambda f: f.reading.temperature[f.i])
    voltage: float = _taken(*_VOLTAGE, lambda f: f.reading.voltage[f.i])
    frame_seq: int = _newest(
        "", "sequence number of the newest tactile frame, 0 before the first frame", lambda f: f.seq
    )
    frame_t: float = _newest(
        "s", "time of the frame's scan on the daemon's clock", lambda f: f.t_sample
    )
    frame_arrival: float = _newest(
        "s", "arrival time of the frame's last byte", lambda f: f.t_arrival
    )
    frame_valid: bool = _newest("", "false if the board is disconnected", lambda f: f.valid)


@topic(
    INPUT,
    "All inputs of each tick, from which `replay --recompute` recomputes the tick.",
    InputSource,
)
class TickInput:
    """One ``hand/input`` message."""

    schema: int = _state(*_SCHEMA, lambda _: SCHEMA)
    seq: int = _state(*_SEQ)
    timestamp: float = _state(*_UNIX, lambda s: s.wall)
    mono_ns: int = _state(*_MONO, lambda s: _ns(s.t))
    t: float = _state("s", "time of the tick with full precision")
    late_in_row: int = _timing("", "number of consecutive overruns")
    busy_s: float = _timing("s", "duration of a recent loop delay caused by a busy machine")
    reading: InputReading = _input.part("", lambda m: m.state)
    left: InputFinger = _input.part("left finger: ", lambda m: _input_finger(m, 0))
    right: InputFinger = _input.part("right finger: ", lambda m: _input_finger(m, 1))
    write_error: str = _state("", "bus error during the write, or empty")
    torque_off: bool = _state("", "the servos confirmed torque off in this tick")


class TruthSource(NamedTuple):
    """Source of a ``hand/truth`` message."""

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
        "m", "maximum displacement, negative for a gap", lambda f: f.truth.d[f.i]
    )
    theta: float = _true_finger(
        "rad", "tilt: object angle relative to the tip", lambda f: f.truth.theta[f.i]
    )
    force: float = _true_finger("N", "force on the tip's base", lambda f: f.truth.force[f.i])


@record
class TrueObject:
    """The object in ``hand/truth``."""

    x: float = _true_pose("m", "x of the object's centre in the hand's frame", lambda p: p[0])
    y: float = _true_pose("m", "y of the object's centre in the hand's frame", lambda p: p[1])
    angle: float = _true_pose("rad", "object angle in the hand's frame", lambda p: p[2])


@topic(TRUTH, "True state of a simulated hand, sent with each `hand/state`.", TruthSource)
class TrueState(_TickMessage):
    """One ``hand/truth`` message.

    The field names differ from those of ``hand/state``, so that all topics can share one plot.
    """

    true_left: TrueFinger = _truth.part("left finger: ", lambda m: _TruthOf(m.truth, 0))
    true_right: TrueFinger = _truth.part("right finger: ", lambda m: _TruthOf(m.truth, 1))
    true_object: TrueObject = _truth.part("", lambda m: m.truth.object_pose)
