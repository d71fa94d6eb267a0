"""The stream's schema: every field of every topic, declared once.

A topic is a record. Each of its fields has a unit, a meaning, and the expression that the daemon
takes it from. From it follow the packers (`wire.packer`), the records that clients read
(`client.records`), the page ``STREAM.md`` and the JSON schemas of recordings (`wire.schema_docs`).

Fields are only ever added, none is left out, and a float is always sent as a float. SI units.
"""

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import FINGERS, Frame
from softfinger.daemon.wire.fields import TOPICS as TOPICS
from softfinger.daemon.wire.fields import field, part, record, topic
from softfinger.daemon.wire.fields import fields_of as fields_of

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

# What several topics begin with.
_SCHEMA = "", "number of this schema; changes only when a field's meaning does", "SCHEMA"
_SEQ = "", "counts up: ticks, frames, events", "seq"
_STEP = "", "one of so many is sent", "step"
_UNIX = "s", "Unix time", "wall"
_MONO = "ns", "the daemon's monotonic clock at the tick", "int(t * 1e9)"
_TICK = {"seq": "state.seq", "wall": "state.wall", "t": "state.t"}
_TEMPERATURE = "°C", "of the servo, 0 while not known", "reading.temperature[{i}]"
_VOLTAGE = "V", "of the servo's supply, 0 while not known", "reading.voltage[{i}]"


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
    again: bool = field("", "repeated for a late subscriber, with its first seq and times", "False")
    timestamp: float = field(*_UNIX)
    mono_ns: int = field("ns", "the daemon's monotonic clock", "int(t * 1e9)")


@record
class FingerState:
    """One finger in ``hand/state``."""

    valid: bool = field(
        "",
        "in the scene, with fresh and sound data from its servo and sensor",
        "scene.fingers[{i}] and read and (contact{i}.valid or not scene.sensors)",
    )
    q: float = field("rad", "joint angle, positive closes", "reading.q[{i}]")
    dq: float = field("rad/s", "joint velocity", "reading.dq[{i}]")
    current: float = field("A", "motor current, positive closes", "reading.current[{i}]")
    temperature: float = field(*_TEMPERATURE)
    voltage: float = field(*_VOLTAGE)
    goal_q: float = field("rad", "goal angle", "goal.q[{i}]")
    goal_current: float = field("A", "bound on the current's magnitude", "goal.current[{i}]")
    d: float = field("m", "maximum displacement of the tip")
    theta: float = field("rad", "the object's angle in the tip's frame, in the hand's plane")
    tilt_y: float = field("rad", "and across the plane")
    force: float = field(
        "N", "elastic force, gain · F(d, total tilt of theta and tilt_y) by the contact table"
    )
    energy: float = field("J", "elastic potential energy, gain · U(d, total tilt) likewise")
    d_std: float = field("m", "standard deviation of d")
    theta_std: float = field("rad", "standard deviation of theta")
    force_std: float = field("N", "standard deviation of force, with that of the tip's law")
    shear_x: float = field(
        "N",
        "force along a solid tip's face, in the hand's plane, by the newest frame; 0 with springs",
    )
    shear_y: float = field("N", "and across the plane")
    gain: float = field("", "measured over modelled pressure")
    misfit: bool = field("", "the frame fits no contact of the model: d, theta may be biased")
    contact: bool = field("", "something touches the tip")
    frame_seq: int = field("", "the estimate's tactile frame, 0 before the first", "contact{i}.seq")
    frame_age_s: float = field(
        "s", "age of that frame's sample", "t - contact{i}.t if contact{i}.seq else 0.0"
    )


@record
class ObjectState:
    """The object in ``hand/state``, from the two contacts."""

    valid: bool = field("", "both contacts give the object's pose")
    angle: float = field(
        "rad",
        "the object's angle in the hand's frame: of its faces' bisector, or of the line between "
        "the contacts of a disc",
    )
    width: float = field("m", "the object's width between the tips")


@topic(
    STATE,
    "What the hand is, does and feels, every n-th tick (`stream.state_rate`).",
    "state, scene, step=1",
    "state.{name}",
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

    mode: str = field("", "disarmed, armed, moving, grasping, holding, rotating, releasing, fault")
    fault: str = field("", "reason of the latched fault, empty when none")
    fault_name: str = field("", "its name in `softfinger.daemon.safety.limits`, empty when none")
    torque: bool = field("", "torque is on, or not known to be off")
    tick_s: float = field("s", "from the last tick's start to this one's", "timing.tick_s")
    compute_s: float = field("s", "work of the last tick", "timing.compute_s")
    wake_late_s: float = field("s", "this tick's start after its deadline", "timing.wake_late_s")
    overruns: int = field("", "ticks whose work outlasted the period", "timing.overruns")
    behind_s: float = field(
        "s",
        "how long a hand simulated in the daemon has waited for a busy machine since the start",
        "timing.behind_s",
    )
    goal_force: float = field(
        "N",
        "mean tip force of the grip: as commanded, or raised against slip; NaN without a grip",
        "goal.force",
    )
    goal_angle: float = field("rad", "object angle of the grip; NaN without one", "goal.angle")
    left: FingerState = part("contact{i}.{name}", "left finger: ", i=0)
    right: FingerState = part("contact{i}.{name}", "right finger: ", i=1)
    object: ObjectState = part("pose.{name}")

    def finger(self, name: str) -> FingerState:
        """``left`` or ``right`` by its name. Raises ValueError for another."""
        if name not in FINGERS:
            raise ValueError(f"found finger {name!r}, expected one of {', '.join(FINGERS)}")
        return self.left if name == FINGERS[0] else self.right


@topic(
    TACTILE,
    "The grids' raw frames (`stream.tactile_rate`), one finger a message.",
    "frame, data, finger, facts, wall, step=1, number=0",
    "facts.{name}",
    seq="frame.seq",
    t="frame.t_sample",
)
@record
class TactileFrame:
    """One ``hand/tactile``. Raises ValueError when its data isn't a grid of rows × cols."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    seq_step: int = field(*_STEP)
    number: int = field("", "counts this sensor's messages: a gap is a loss on the way", "number")
    timestamp: float = field(*_UNIX)
    mono_ns: int = field("ns", "the daemon's monotonic clock at the board's scan", "int(t * 1e9)")
    delay_s: float = field("s", "from the scan until the frame had come", "frame.t_arrival - t")
    valid: bool = field("", "false: the board is gone, this is its last frame again", "frame.valid")
    finger: str = field("", "left or right", "FINGERS[finger]")
    rows: int = field("", "cells along y", "data.shape[0]")
    cols: int = field("", "cells along x", "data.shape[1]")
    pitch: float = field("m", "from column to column")
    pitch_y: float = field("m", "from row to row")
    centre_x: float = field("m", "the tip's centre off the grid's, along x")
    centre_y: float = field("m", "and along y")
    rotation: float = field("rad", "of the sensor's axes against the finger's")
    unit: str = field("", "`count`: as the board sent it; `Pa`: as it was estimated")
    scale: float = field("Pa", "one step of the data, exact for linear sensors")
    calibrated: bool = field("", "data × scale is the pressure by the calibration")
    calibration: str = field("", "name and date of the estimator's calibration, or empty")
    data: bytes = field(
        "",
        "rows × cols little-endian uint16, row by row",
        "data.astype('<u2', copy=False).tobytes()",
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

    level: str = field("", "info, warning or error")
    kind: str = field("", "what it is about: mode, fault, servos, …")
    text: str = field("", "one line for a person")


@record
class Spread:
    """One of the loop's times in ``hand/stats``."""

    p50: float = field("s", "median")
    p99: float = field("s", "99 % are below")
    p999: float = field("s", "99.9 % are below")
    max: float = field("s", "longest")


@record
class Rates:
    """How often things have happened over the last second, in ``hand/stats``."""

    tick: float = field("Hz", "ticks")
    left: float = field("Hz", "tactile frames that came from the left sensor")
    right: float = field("Hz", "tactile frames that came from the right sensor")
    state: float = field("Hz", "states that went out")
    tactile: float = field("Hz", "tactile frames that went out")


@topic(
    STATS,
    "Once a second, how the loop keeps its time.",
    "state, period, rates, statistics, step=1",
    "statistics.{name}",
    **_TICK,
    spreads="statistics.spreads()",
)
@record
class LoopStatistics(_TickMessage):
    """One ``hand/stats``."""

    ticks: int = field("", "since the start, as all of this but the rates")
    overruns: int = field("", "ticks whose work outlasted the period", "state.timing.overruns")
    period_s: float = field("s", "the tick's period", "period")
    wake: Spread = part("spreads['wake'].{name}", "a tick's start after its deadline: ")
    compute: Spread = part("spreads['compute'].{name}", "all of a tick's work: ")
    bus: Spread = part("spreads['bus'].{name}", "reading and writing the servos: ")
    publish: Spread = part("spreads['publish'].{name}", "publishing: ")
    rates: Rates = part("rates.{name}", "over the last second: ")


@topic(
    SETTINGS,
    "Once, and again for late subscribers: what this hand is.",
    "seq, wall, t, facts",
    "facts.{name}",
)
@record
class HandSettings(_Announcement):
    """One ``hand/settings``."""

    version: str = field("", "of softfinger")
    settings: str = field("", "all settings, as JSON")
    calibration_left: str = field("", "the left sensor's calibration as JSON, or empty")
    calibration_right: str = field("", "the right sensor's")
    table_left: str = field(
        "", "the left tip's contact table: form, tolerance, certificate (bound of its error)"
    )
    table_right: str = field("", "the right tip's")


@topic(
    COMMAND,
    "Each command that was answered, by whomever; `status` is left out.",
    "seq, wall, t, tick, request, error",
)
@record
class AnsweredCommand(_Announcement):
    """One ``hand/command``."""

    tick: int = field("", "seq of the tick at which it was answered")
    command: str = field("", "its name", "str(request.get('command', ''))")
    client: str = field(
        "", "who sent it, empty for all who give no name", "str(request.get('client', ''))"
    )
    request: str = field("", "all of it, as JSON", "json.dumps(request, default=str)")
    ok: bool = field("", "carried out", "not error")
    error: str = field("", "why it was refused, empty when it was carried out")


@record
class InputReading:
    """The servos' reading in ``hand/input``."""

    seq: int = field("", "readings of the servos")
    t: float = field("s", "when the last good one was taken; −∞ before it")
    valid: bool = field("", "this tick's is good")
    alert: int = field("", "bit i: servo of finger i reports a hardware error")
    error: str = field("", "what the bus failed with, or empty", "state.read_error")
    lost: int = field("", "bit i: servo of finger i holds none of the last goals")
    frozen: int = field("", "bit i: servo of finger i measures nothing new")


@record
class InputFinger:
    """One finger in ``hand/input``."""

    q: float = field("rad", "joint angle")
    dq: float = field("rad/s", "joint velocity")
    current: float = field("A", "motor current")
    hardware: int = field("", "the servo's hardware error bits, 0 if not known")
    temperature: float = field(*_TEMPERATURE)
    voltage: float = field(*_VOLTAGE)
    frame_seq: int = field("", "newest tactile frame, 0 before the first", "frame{i}.seq")
    frame_t: float = field("s", "when it was scanned, by the daemon's clock", "frame{i}.t_sample")
    frame_arrival: float = field("s", "when it was complete here", "frame{i}.t_arrival")
    frame_valid: bool = field("", "false: the board is gone", "frame{i}.valid")


@topic(
    INPUT,
    "All that a tick took in, every tick: what `replay --recompute` starts from.",
    "state, frames",
    "state.{name}",
    **_TICK,
    reading="state.reading",
    timing="state.timing",
    frame0="frames[0] or NO_FRAME",
    frame1="frames[1] or NO_FRAME",
)
@record
class TickInput:
    """One ``hand/input``."""

    schema: int = field(*_SCHEMA)
    seq: int = field(*_SEQ)
    timestamp: float = field(*_UNIX)
    mono_ns: int = field(*_MONO)
    t: float = field("s", "the same, with all its digits", "t")
    late_in_row: int = field("", "consecutive overruns", "timing.late_in_row")
    busy_s: float = field("s", "how long a busy machine has just held up the loop", "timing.busy_s")
    reading: InputReading = part("reading.{name}")
    left: InputFinger = part("reading.{name}[{i}]", "left finger: ", i=0)
    right: InputFinger = part("reading.{name}[{i}]", "right finger: ", i=1)
    write_error: str = field("", "what the bus failed with when written to, or empty")
    torque_off: bool = field("", "the servos confirmed at this tick that torque is off")


@record
class TrueFinger:
    """One finger in ``hand/truth``."""

    d: float = field("m", "maximum displacement, negative: a gap", "float(truth.d[{i}])")
    theta: float = field("rad", "the object's angle in the tip's frame", "float(truth.theta[{i}])")
    force: float = field("N", "on the tip's base", "float(truth.force[{i}])")


@record
class TrueObject:
    """The object in ``hand/truth``."""

    x: float = field("m", "the object's centre in the hand's frame", "float(pose[0])")
    y: float = field("m", "and along y", "float(pose[1])")
    angle: float = field("rad", "the object's angle in the hand's frame", "float(pose[2])")


@topic(
    TRUTH,
    "A simulated hand's own knowledge, with each state. No real hand has it.",
    "state, truth, step=1",
    **_TICK,
    pose="truth.object_pose",
)
@record
class TrueState(_TickMessage):
    """One ``hand/truth``, by names of its own: a plot of all topics keeps them apart."""

    true_left: TrueFinger = part("", "left finger: ", i=0)
    true_right: TrueFinger = part("", "right finger: ", i=1)
    true_object: TrueObject = part("")
