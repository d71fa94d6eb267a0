"""The plain records that the pipeline's stages hand to each other, and nothing else.

Per-finger lists have length 2, left finger first; a finger that the scene lacks stays 0 and is
flagged by ``valid``. Plain floats, since the tick takes them one by one. SI units. Positive joint
angle closes. ``t`` is the clock's time in seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from softfinger.kinematics.estimation.invalid import Invalid

if TYPE_CHECKING:  # a command's client needs no NumPy
    import numpy as np
    from numpy.typing import NDArray

FINGERS = ("left", "right")
STREAM_ADDRESS = "tcp://127.0.0.1:9872"  # unless settings or a client say otherwise
COMMAND_ADDRESS = "tcp://127.0.0.1:9873"
UNLEASED = frozenset({"stop", "disarm", "status"})  # commands that can only make the hand safer
GRIP_FRACTION = 0.9  # of `safety.force_max` that a grip may be asked for, or raised to by itself
Event = tuple[str, str, str]  # level, kind, text


def _pair() -> list[float]:
    return [0.0, 0.0]


@dataclass(slots=True)
class Reading:
    """The joints as they were read last. Filled in place by ``Servos.read``."""

    seq: int = 0
    t: float = -math.inf  # when the last good one was taken
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # joint angle [rad]
    dq: list[float] = field(default_factory=_pair)  # joint velocity [rad/s]
    current: list[float] = field(default_factory=_pair)  # motor current [A], positive closes
    alert: int = 0  # bit i: servo of finger i reports a hardware error
    lost: int = 0  # bit i: it has none of the goals that were sent lately
    frozen: int = 0  # bit i: its clock has stopped, so what it measures is old
    hardware: list[int] = field(default_factory=lambda: [0, 0])  # its error bits, 0 if not known
    temperature: list[float] = field(default_factory=_pair)  # [°C], 0 while not known
    voltage: list[float] = field(default_factory=_pair)  # of the supply [V], likewise


@dataclass(slots=True)
class Frame:
    """One tactile frame. ``data`` is never written after it was handed over."""

    seq: int
    t_sample: float  # when the board scanned it (middle of the scan, best estimate) [s]
    t_arrival: float  # when it was complete here [s]
    valid: bool
    data: NDArray[np.uint16]  # counts [rows, cols]


@dataclass(slots=True)
class Contact:
    """Contact of one fingertip: the newest frame's estimate, predicted by the joints since."""

    seq: int = 0  # of the frame
    t: float = 0.0  # when that frame was sampled [s]
    t_arrival: float = 0.0  # and when it was complete here [s]
    t_valid: float = 0.0  # arrival of the last frame whose estimate was valid [s]
    invalid: Invalid = Invalid.NO_FRAME  # why the estimate can't be used
    contact: bool = False  # something touches the tip
    d: float = 0.0  # maximum displacement [m]
    theta: float = 0.0  # the object's angle in the tip's frame, in the hand's plane [rad]
    tilt_y: float = 0.0  # and across it [rad]
    d_std: float = 0.0  # standard deviations of d [m], see `ContactEstimate`, and theta [rad]
    theta_std: float = 0.0
    gain: float = 1.0  # measured pressure over modelled pressure
    modulus_scale: float = 1.0  # of the tip's modulus over the settings' …
    modulus_scale_std: float = 0.0
    sensor_gain: float = 1.0  # … and of the sensor, whose product is `gain`, …
    sensor_gain_std: float = 0.0
    torque_scale: float = 1.0  # … and of the joint's torque constant over the settings'
    torque_scale_std: float = 0.0
    # Averaged normalised innovations squared of the sensor's channels, about 1 if consistent
    nis_angle: float = 1.0
    nis_footprint: float = 1.0
    nis_amplitude: float = 1.0
    misfit: bool = False  # the frame fits no contact of the model: d and theta may be biased
    force: float = 0.0  # modulus_scale · F(d, total tilt of theta and tilt_y) by the table [N]
    energy: float = 0.0  # modulus_scale · U(d, total tilt) [J]
    force_std: float = 0.0  # standard deviation of force [N], with the table's and the law's error
    shear_x: float = 0.0  # force on the tip's face [N] along x and y, of a solid tip's newest frame
    shear_y: float = 0.0
    inside: bool = True  # (d, θ) lies inside the model's domain

    @property
    def valid(self) -> bool:
        """A frame has come, its estimate is sound and it is not too old."""
        return not self.invalid


@dataclass(slots=True)
class ObjectPose:
    """The object's angle [rad] and width [m], from the two contacts."""

    valid: bool = False
    angle: float = 0.0
    width: float = 0.0
    nis_torque: float = 1.0  # averaged normalised innovation squared of the joint torques …
    nis_balance: float = 1.0  # … and of the balance of both tips


@dataclass(slots=True)
class Goal:
    """Goals of the servos. Filled in place by the control law, bounded by safety."""

    seq: int = 0
    t: float = 0.0
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # goal angle [rad]
    current: list[float] = field(default_factory=_pair)  # bound on the current's magnitude [A]
    force: float = math.nan  # target of the tips' mean force [N], NaN without a grip
    angle: float = math.nan  # target of the object's angle [rad], NaN without one


@dataclass(slots=True)
class Warmth:
    """A servo's heat as `safety.heat` follows it; 0 while no temperature is known."""

    winding: float = 0.0  # [°C]
    winding_std: float = 0.0  # standard deviation [°C]
    case: float = 0.0  # what its thermometer shows, without its steps [°C]
    case_std: float = 0.0
    ambient: float = 0.0  # [°C]
    time_to_limit: float = 3600.0  # to `safety.temperature_max` with this current, at most [s]


@dataclass(slots=True)
class Timing:
    """The loop's own times [s], by this machine's clock."""

    tick_s: float = 0.0  # from this tick's start to the last one's
    compute_s: float = 0.0  # work of the last tick
    wake_late_s: float = 0.0  # this tick's start after its deadline
    overruns: int = 0  # ticks whose work outlasted the period
    late_in_row: int = 0  # consecutive late ticks; 0 where the hand's time waits
    behind_s: float = 0.0  # that a simulated hand has waited for this machine since the start
    busy_s: float = 0.0  # that this machine has just kept the loop from a tick, or 0


@dataclass(slots=True)
class State:
    """All of the above for one tick: what is published."""

    seq: int = 0
    t: float = 0.0
    wall: float = 0.0  # Unix time [s]
    mode: str = "disarmed"
    fault: str = ""
    fault_name: str = ""  # its limit in `safety.limits`
    torque: bool = False  # on, or not confirmed to be off
    torque_off: bool = False  # the servos confirmed at this tick that it is off
    read_error: str = ""  # of the servos' bus at this tick
    write_error: str = ""
    reading: Reading = field(default_factory=Reading)
    contacts: list[Contact] = field(default_factory=lambda: [Contact(), Contact()])
    object: ObjectPose = field(default_factory=ObjectPose)
    goal: Goal = field(default_factory=Goal)
    heat: list[Warmth] = field(default_factory=lambda: [Warmth(), Warmth()])
    timing: Timing = field(default_factory=Timing)


class Parts(NamedTuple):
    """Parts of the scene: its fingers, and their servos and sensors."""

    fingers: tuple[bool, bool]
    servos: bool
    sensors: bool


class TimeSpread(NamedTuple):
    """One of the loop's times: median, tail and largest value since the start [s]."""

    p50: float
    p99: float
    p999: float
    max: float


class SensorFacts(NamedTuple):
    """Facts of a tactile sensor that are published with each frame; see ``hand/tactile``."""

    pitch: float  # from column to column [m]
    pitch_y: float  # from row to row [m]
    centre_x: float  # the tip's centre off the grid's [m]
    centre_y: float
    rotation: float  # of the sensor's axes against the finger's [rad]
    unit: str  # of the published data: "count" or "Pa"
    scale: float  # one step of the data [Pa]
    calibrated: bool
    calibration: str  # name and date, or empty


class HandFacts(NamedTuple):
    """Facts that don't change while a daemon runs; texts of JSON, empty where there is nothing."""

    version: str
    settings: str
    calibration_left: str
    calibration_right: str
    table_left: str
    table_right: str


class Truth(Protocol):
    """True state of a simulated hand: arrays of both tips, and the object's x, y, φ."""

    d: NDArray[np.float64]
    theta: NDArray[np.float64]
    force: NDArray[np.float64]
    object_pose: NDArray[np.float64]
