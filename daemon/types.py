"""Define the plain records that the stages of the pipeline exchange.

Lists by finger have length 2, left finger first. The values of a finger that the scene lacks stay
0, and ``valid`` is False. Values are plain floats, because the tick accesses them one at a time.
All units are SI. A positive joint angle closes the finger. ``t`` is the clock's time in seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from softfinger.kinematics.estimation.invalid import Invalid

if TYPE_CHECKING:  # a client that only sends commands needs no NumPy
    import numpy as np
    from numpy.typing import NDArray

FINGERS = ("left", "right")
STREAM_ADDRESS = "tcp://127.0.0.1:9872"  # default addresses
COMMAND_ADDRESS = "tcp://127.0.0.1:9873"
NO_LEASE_COMMANDS = frozenset({"stop", "disarm", "status"})  # these only make the hand safer
GRIP_FRACTION = 0.9  # largest grip force as a fraction of `safety.force_max`
Event = tuple[str, str, str]  # level, kind, text


def _pair() -> list[float]:
    return [0.0, 0.0]


@dataclass(slots=True)
class Reading:
    """Latest joint measurements. ``Servos.read`` updates them in place."""

    seq: int = 0
    t: float = -math.inf  # time of the last good reading
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # joint angle [rad]
    dq: list[float] = field(default_factory=_pair)  # joint velocity [rad/s]
    current: list[float] = field(default_factory=_pair)  # motor current [A], positive closes
    alert: int = 0  # bit i: servo of finger i reports a hardware error
    lost: int = 0  # bit i: that servo received none of the recent goals
    frozen: int = 0  # bit i: that servo's clock has stopped, so its measurements are stale
    hardware: list[int] = field(default_factory=lambda: [0, 0])  # hardware error bits, 0 if unknown
    temperature: list[float] = field(default_factory=_pair)  # [°C], 0 while unknown
    voltage: list[float] = field(default_factory=_pair)  # supply voltage [V], 0 while unknown


@dataclass(slots=True)
class Frame:
    """One tactile frame. ``data`` is not modified after the sensor has delivered it."""

    seq: int
    t_sample: float  # estimated time of the middle of the board's scan [s]
    t_arrival: float  # time when the frame was received completely [s]
    valid: bool
    data: NDArray[np.uint16]  # counts [rows, cols]


@dataclass(slots=True)
class Contact:
    """Contact of one fingertip: the newest frame's estimate, predicted with later joint angles."""

    seq: int = 0  # sequence number of the frame
    t: float = 0.0  # sample time of that frame [s]
    t_arrival: float = 0.0  # arrival time of that frame [s]
    t_valid: float = 0.0  # arrival of the last frame whose estimate was valid [s]
    invalid: Invalid = Invalid.NO_FRAME  # reason why the estimate is invalid
    contact: bool = False  # something touches the tip
    d: float = 0.0  # maximum displacement [m]
    theta: float = 0.0  # object angle in the tip's frame, in the hand's plane [rad]
    tilt_y: float = 0.0  # object angle across the hand's plane [rad]
    d_std: float = 0.0  # standard deviations of d [m], see `ContactEstimate`, and theta [rad]
    theta_std: float = 0.0
    gain: float = 1.0  # measured pressure over modelled pressure
    modulus_scale: float = 1.0  # tip modulus over the settings' modulus
    modulus_scale_std: float = 0.0
    sensor_gain: float = 1.0  # sensor gain; `gain` is modulus_scale · sensor_gain
    sensor_gain_std: float = 0.0
    torque_scale: float = 1.0  # torque constant in the settings over the true one
    torque_scale_std: float = 0.0
    # Averaged normalised innovation squared of each sensor channel, about 1 if consistent.
    nis_angle: float = 1.0
    nis_footprint: float = 1.0
    nis_amplitude: float = 1.0
    misfit: bool = False  # no contact of the model fits the frame; d and theta may be biased
    force: float = 0.0  # normal force from the table, modulus_scale · F(d, total tilt) [N]
    energy: float = 0.0  # modulus_scale · U(d, total tilt) [J]
    force_std: float = 0.0  # [N], including the errors of the table and the material law
    shear_x: float = 0.0  # shear force [N], from the newest frame of a solid tip
    shear_y: float = 0.0
    inside: bool = True  # (d, θ) lies inside the model's domain

    @property
    def valid(self) -> bool:
        """True if a frame has arrived, its estimate is sound and it is not too old."""
        return not self.invalid


@dataclass(slots=True)
class ObjectPose:
    """Object angle [rad] and width [m], computed from the two contacts."""

    valid: bool = False
    angle: float = 0.0
    width: float = 0.0
    nis_torque: float = 1.0  # averaged normalised innovation squared of the joint torques
    nis_balance: float = 1.0  # averaged normalised innovation squared of the tips' force balance


@dataclass(slots=True)
class Goal:
    """Goals of the servos. The control law sets them in place and `safety` limits them."""

    seq: int = 0
    t: float = 0.0
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # goal angle [rad]
    current: list[float] = field(default_factory=_pair)  # limit of the current's magnitude [A]
    force: float = math.nan  # target of the tips' mean force [N], NaN without a grip
    angle: float = math.nan  # target of the object's angle [rad], NaN without one


@dataclass(slots=True)
class ServoHeatEstimate:
    """Temperatures of a servo from the thermal model in `safety.heat`; 0 while unknown."""

    winding: float = 0.0  # [°C]
    winding_std: float = 0.0  # standard deviation [°C]
    case: float = 0.0  # case temperature without the thermometer's quantisation [°C]
    case_std: float = 0.0
    ambient: float = 0.0  # [°C]
    time_to_limit: float = 3600.0  # time until `safety.temperature_max` at this current, capped [s]


@dataclass(slots=True)
class Timing:
    """Timing of the loop [s], by this machine's clock."""

    tick_s: float = 0.0  # from the start of the last tick to the start of this one
    compute_s: float = 0.0  # computing time of the last tick
    wake_late_s: float = 0.0  # delay of this tick's start after its deadline
    overruns: int = 0  # ticks that took longer than the period
    late_in_row: int = 0  # consecutive late ticks; 0 if the hand's time waits
    behind_s: float = 0.0  # total time that a simulated hand has waited for this machine
    busy_s: float = 0.0  # length of a recent stall of this machine, 0 without one


@dataclass(slots=True)
class State:
    """Complete state of one tick, as it is published."""

    seq: int = 0
    t: float = 0.0
    wall: float = 0.0  # Unix time [s]
    mode: str = "disarmed"
    fault: str = ""
    fault_name: str = ""  # name of the limit in `safety.limits`
    torque: bool = False  # True if on or not confirmed off
    torque_off: bool = False  # True if the servos confirmed torque off in this tick
    read_error: str = ""  # error of the servo bus in this tick
    write_error: str = ""
    reading: Reading = field(default_factory=Reading)
    contacts: list[Contact] = field(default_factory=lambda: [Contact(), Contact()])
    object: ObjectPose = field(default_factory=ObjectPose)
    goal: Goal = field(default_factory=Goal)
    heat: list[ServoHeatEstimate] = field(
        default_factory=lambda: [ServoHeatEstimate(), ServoHeatEstimate()]
    )
    timing: Timing = field(default_factory=Timing)


class SceneParts(NamedTuple):
    """Fingers of the scene, and the presence of servos and sensors."""

    fingers: tuple[bool, bool]
    has_servos: bool
    has_sensors: bool


class TimeSpread(NamedTuple):
    """Median, tail quantiles and maximum of one of the loop's times since the start [s]."""

    p50: float
    p99: float
    p999: float
    max: float


class SensorInfo(NamedTuple):
    """Properties of a tactile sensor that are published with each frame; see ``hand/tactile``."""

    pitch: float  # distance between columns [m]
    pitch_y: float  # distance between rows [m]
    centre_x: float  # offset of the tip's centre from the grid's centre [m]
    centre_y: float
    rotation: float  # rotation of the sensor's axes relative to the finger's [rad]
    unit: str  # of the published data: "count" or "Pa"
    scale: float  # pressure of one step of the data [Pa]
    calibrated: bool
    calibration: str  # name and date, empty without a calibration


class HandInfo(NamedTuple):
    """Facts that stay constant while a daemon runs, as JSON texts; empty if not available."""

    version: str
    settings: str
    calibration_left: str
    calibration_right: str
    table_left: str
    table_right: str


class Truth(Protocol):
    """True state of a simulated hand: arrays over both tips, and the object's x, y and φ."""

    d: NDArray[np.float64]
    theta: NDArray[np.float64]
    force: NDArray[np.float64]
    object_pose: NDArray[np.float64]
