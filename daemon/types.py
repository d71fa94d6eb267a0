"""Define the plain records that the pipeline stages exchange.

Per-finger lists have two entries, the left finger first. For a finger that is not in the scene, the
values stay 0 and ``valid`` is False. Values are plain floats because the code accesses the values
one at a time. All quantities are in SI units. A positive joint angle closes the finger. ``t`` is
the clock time in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from softfinger.kinematics.estimation.invalid import Invalid

if TYPE_CHECKING:  # Clients that only send commands do not need NumPy.
    import numpy as np
    from numpy.typing import NDArray

FINGERS = ("left", "right")
STREAM_ADDRESS = "tcp://127.0.0.1:9872"  # default addresses
COMMAND_ADDRESS = "tcp://127.0.0.1:9873"
# Commands that cannot make the hand less safe.
NO_LEASE_COMMANDS = frozenset({"stop", "disarm", "status"})
GRIP_FRACTION = 0.9  # maximum grip force as a fraction of `safety.force_max`
Event = tuple[str, str, str]  # level, kind, text
EventSink = Callable[[str, str, str], None]  # function that takes an event's level, kind and text


def _pair() -> list[float]:
    return [0.0, 0.0]


@dataclass(slots=True)
class Reading:
    """Latest joint measurements, which ``Servos.read`` updates in place."""

    seq: int = 0
    t: float = -math.inf  # time of the last valid reading [s]
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # joint angle [rad]
    dq: list[float] = field(default_factory=_pair)  # joint velocity [rad/s]
    current: list[float] = field(default_factory=_pair)  # motor current [A], positive when closing
    alert: int = 0  # bit i: servo i reports a hardware error
    lost: int = 0  # bit i: servo i has received none of the recent goals
    frozen: int = 0  # bit i: servo i's clock has stopped, so its measurements are stale
    hardware: list[int] = field(default_factory=lambda: [0, 0])  # hardware error bits, 0 if unknown
    temperature: list[float] = field(default_factory=_pair)  # [°C], 0 while unknown
    voltage: list[float] = field(default_factory=_pair)  # supply voltage [V], 0 while unknown


@dataclass(slots=True)
class Frame:
    """One tactile frame. The sensor does not modify ``data`` after delivery."""

    seq: int
    t_sample: float  # estimated time at the middle of the board's scan [s]
    t_arrival: float  # time when the complete frame was received [s]
    valid: bool
    data: NDArray[np.uint16]  # counts [rows, cols]


@dataclass(slots=True)
class Contact:
    """Contact of one fingertip, estimated from the newest frame and later joint angles."""

    seq: int = 0  # sequence number of the frame
    t: float = 0.0  # sample time of the frame [s]
    # Arrival times of the frame and of the last frame with a valid estimate, or -inf [s].
    t_arrival: float = -math.inf
    t_valid: float = -math.inf
    invalid: Invalid = Invalid.NO_FRAME  # reason why the estimate is invalid
    contact: bool = False  # True if the tip is in contact
    d: float = 0.0  # maximum displacement [m]
    theta: float = 0.0  # object angle relative to the tip, in the hand plane [rad]
    tilt_y: float = 0.0  # object angle perpendicular to the hand plane [rad]
    d_std: float = 0.0  # standard deviation of d [m]; see `ContactEstimate`
    theta_std: float = 0.0  # standard deviation of theta [rad]
    gain: float = 1.0  # ratio of measured to modelled pressure
    modulus_scale: float = 1.0  # ratio of the tip modulus to its setting
    modulus_scale_std: float = 0.0
    sensor_gain: float = 1.0  # `gain` equals modulus_scale · sensor_gain
    sensor_gain_std: float = 0.0
    torque_scale: float = 1.0  # torque constant in the settings divided by the true torque constant
    torque_scale_std: float = 0.0
    # Average normalised innovation squared of each sensor channel. A consistent channel has a value
    # of about 1.
    nis_angle: float = 1.0
    nis_footprint: float = 1.0
    nis_amplitude: float = 1.0
    misfit: bool = False  # True if the model does not fit the frame; d and theta may be biased
    force: float = 0.0  # elastic tip force, modulus_scale · relaxation · F(d, total tilt) [N]
    energy: float = 0.0  # modulus_scale · U(d, total tilt) [J]
    force_std: float = 0.0  # standard deviation [N], including table, material law and relaxation
    shear_x: float = 0.0  # shear force from the newest frame of a solid tip [N]
    shear_y: float = 0.0
    inside: bool = True  # True if (d, θ) is inside the model's domain

    @property
    def valid(self) -> bool:
        """True if a recent frame exists and its estimate is valid."""
        return not self.invalid


@dataclass(slots=True)
class ObjectPose:
    """Object angle [rad] and width [m], computed from the two contacts."""

    valid: bool = False
    angle: float = 0.0
    width: float = 0.0
    nis_torque: float = 1.0  # average normalised innovation squared of the joint torques
    nis_balance: float = 1.0  # average normalised innovation squared of the tip force balance


@dataclass(slots=True)
class Goal:
    """Servo goals. The control law modifies the goals in place, and `safety` limits the goals."""

    seq: int = 0
    t: float = 0.0
    valid: bool = False
    q: list[float] = field(default_factory=_pair)  # goal angle [rad]
    current: list[float] = field(default_factory=_pair)  # limit for the absolute motor current [A]
    force: float = math.nan  # target mean tip force [N], NaN without a grip
    angle: float = math.nan  # target object angle [rad], NaN if not set


@dataclass(slots=True)
class ServoHeatEstimate:
    """Servo temperatures, computed by the thermal model in `safety.heat`; 0 while unknown."""

    winding: float = 0.0  # [°C]
    winding_std: float = 0.0  # standard deviation [°C]
    case: float = 0.0  # case temperature, without the thermometer's quantisation [°C]
    case_std: float = 0.0
    ambient: float = 0.0  # ambient temperature [°C]
    time_to_limit: float = 3600.0  # time until `safety.temperature_max` is reached, at most 1 h [s]


@dataclass(slots=True)
class Timing:
    """Loop timing [s], measured by this machine's clock."""

    tick_s: float = 0.0  # interval between the starts of the previous tick and this tick
    compute_s: float = 0.0  # computing time of the previous tick
    wake_late_s: float = 0.0  # delay of this tick's start relative to its deadline
    overruns: int = 0  # number of ticks that took longer than the period
    late_in_row: int = 0  # number of consecutive late ticks, or 0 if the hand's clock pauses
    behind_s: float = 0.0  # total time that a simulated hand has waited for this machine
    busy_s: float = 0.0  # duration of a recent stall of this machine, or 0


@dataclass(slots=True)
class State:
    """Complete published state of one tick."""

    seq: int = 0
    t: float = 0.0
    wall: float = 0.0  # Unix time [s]
    mode: str = "disarmed"
    fault: str = ""
    fault_name: str = ""  # limit name in `safety.limits`
    torque: bool = False  # True if torque is on, or if the servos have not confirmed that it is off
    torque_off: bool = False  # True if the servos confirmed on this tick that torque is off
    read_error: str = ""  # error while reading the servo bus on this tick
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
    """Components of the scene: fingers, servos and sensors."""

    fingers: tuple[bool, bool]
    has_servos: bool
    has_sensors: bool


class TimeSpread(NamedTuple):
    """Median, tail quantiles and maximum of one loop duration [s] since startup."""

    p50: float
    p99: float
    p999: float
    max: float


class SensorInfo(NamedTuple):
    """Tactile sensor properties published with each frame; see ``hand/tactile``."""

    pitch: float  # distance between columns [m]
    pitch_y: float  # distance between rows [m]
    centre_x: float  # offset of the tip centre from the grid centre [m]
    centre_y: float
    rotation: float  # rotation of the sensor axes relative to the finger axes [rad]
    unit: str  # unit of the published data: "count" or "Pa"
    scale: float  # pressure per data step [Pa]
    calibrated: bool
    calibration: str  # name and date of the calibration, or empty if uncalibrated


class HandInfo(NamedTuple):
    """JSON texts that stay constant while a daemon runs; unavailable texts are empty."""

    version: str
    settings: str
    calibration_left: str
    calibration_right: str
    table_left: str
    table_right: str


class Truth(Protocol):
    """True state of a simulated hand: arrays for both tips, and the object pose x, y, φ."""

    d: NDArray[np.float64]
    theta: NDArray[np.float64]
    force: NDArray[np.float64]
    object_pose: NDArray[np.float64]
