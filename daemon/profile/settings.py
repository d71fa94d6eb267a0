"""Define the sections of a profile, and the default, bounds, unit and meaning of each setting.

The defaults describe the built-in simulated hand. `profile.load` reads and validates a file.
`profile.reference` generates ``config/sim.toml`` and the JSON schema from the declarations in this
module. All pairs are in the order (left, right).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict

from softfinger.daemon.backends import BUILT_IN, backend
from softfinger.daemon.profile.fields import (
    Angle,
    Counts,
    Delay,
    Factor,
    Finite,
    Fraction,
    Index,
    Length,
    Modulus,
    NonNegative,
    Place,
    Positive,
    Processor,
    Rate,
    Seconds,
    Section,
    ServoId,
    ServoModel,
    names_backend,
    setting,
)
from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.types import COMMAND_ADDRESS, FINGERS, STREAM_ADDRESS

Cells = tuple[tuple[Index, Index], ...]


class SceneSettings(Section):
    """Parts of the hand. The backend ``none`` removes the servos or the sensors."""

    fingers: tuple[Literal["left", "right"], ...] = setting(
        ("left", "right"), "", "Fingers of the hand, one or two.", min_length=1, max_length=2
    )
    object_model: bool = setting(
        True, "", "Estimate the object's angle and width from both contacts."
    )

    @property
    def indices(self) -> list[int]:
        """Indices of the fingers: 0 for the left finger, 1 for the right finger."""
        return sorted(FINGERS.index(name) for name in self.fingers)


class GeometrySettings(Section):
    """Two rotational fingers in a plane.

    The pivots are at (∓pivot_separation/2, 0). A positive joint angle q closes the finger.
    """

    pivot_separation: Length = setting(0.100, "m", "Distance between the axes of the two joints.")
    finger_length: Length = setting(
        0.080, "m", "Distance from the axis to the centre of the tip's base, along the finger."
    )
    finger_offset: Place = setting(
        0.0, "m", "Distance from the axis to the centre of the tip's base, across the finger; "
        "positive towards the other finger."
    )  # fmt: skip
    q_min: tuple[Angle, Angle] = setting((-0.5, -0.5), "rad", "Joint angle when fully open.")
    q_max: tuple[Angle, Angle] = setting((1.0, 1.0), "rad", "Maximum joint angle when closing.")
    open_angle: tuple[Angle, Angle] = setting((0.0, 0.0), "rad", "Target joint angle of `release`.")


class TipSettings(Section):
    """The soft hemispherical fingertip.

    `calibrate law` stores measured curves in the files named by ``tactile.calibration``.
    """

    radius: Length = setting(0.020, "m", "Radius of the hemispherical tip.")
    physics: Literal["springs", "solid", "measured"] = setting(
        "springs", "", "Contact model: the paper's springs, solid rubber, or measured curves."
    )
    poisson: float = setting(0.49, "", "Poisson's ratio of a solid tip.", ge=0.45, le=0.4995)
    base: Literal["bonded", "lying"] = setting(
        "bonded",
        "",
        "Base of a solid tip: bonded to the sensor, or resting on it and free to slide.",
    )
    face: Literal["frictionless", "sticking"] = setting(
        "frictionless", "", "Contact between a solid tip and the object: sticking or frictionless."
    )
    relaxation: tuple[Fraction, Fraction, Fraction] = setting(
        (0.0, 0.0, 0.0), "", "Amplitudes of three Prony terms, as fractions of the tip's final "
        "stiffness."
    )  # fmt: skip
    relaxation_times: tuple[Positive, Positive, Positive] = setting(
        (0.004, 0.07, 1.4), "s", "Time constants of the Prony terms; the defaults are those of a "
        "human fingerpad (Pawluk & Howe, 1999)."
    )  # fmt: skip


class MaterialSettings(Section):
    """Stress-strain law of the tip: the paper's Table I, a constant modulus, or measured points."""

    law: Literal["table_i", "constant", "points"] = setting("table_i", "", "Stress-strain law.")
    modulus: Modulus = setting(0.304e6, "Pa", 'Modulus for law = "constant".')
    strain: tuple[Finite, ...] = setting(
        (), "", 'Strains of the stress-strain points for law = "points".'
    )
    stress: tuple[Finite, ...] = setting(
        (), "Pa", 'Stresses of the stress-strain points for law = "points".'
    )
    modulus_error: float = setting(
        0.0, "", "Relative standard deviation of the modulus.", ge=0, le=1
    )
    force_error_max: Positive = setting(
        0.05, "",
            "Maximum relative force error of the curve fitted to the points, for d > "
            "radius/20. The profile is rejected if the error is larger."
    )  # fmt: skip


class TableSettings(Section):
    """The contact table, a lookup table of force, energy and their partial derivatives."""

    tolerance: float = setting(
        1e-9, "", "Maximum relative error of the table lookup.", ge=1e-9, le=1e-2
    )


class ServoSettings(Section):
    """The servos of the joints."""

    backend: Annotated[str, names_backend("servos")] = setting(
        "simulated", "", "Servo driver.", examples=[*BUILT_IN["servos"]]
    )
    port: str = setting(
        "/dev/ttyUSB0", "", 'Serial port; "{dir}" is replaced by the folder given with --dir.'
    )
    baud: int = setting(2_000_000, "bit/s", "Baud rate of the bus.", ge=9600, le=4_500_000)
    model: ServoModel = setting("XM430-W350", "", "Model of both servos.")
    ids: tuple[ServoId, ServoId] = setting((1, 2), "", "IDs of the servos on the bus.")
    direction: tuple[Literal[-1, 1], Literal[-1, 1]] = setting(
        (1, -1), "", "1 if the servo position increases when the finger closes, otherwise -1."
    )
    zero: tuple[Counts, Counts] = setting((2048, 2048), "counts", "Servo position at q = 0.")
    gear_ratio: Positive = setting(1.0, "", "Servo revolutions per joint revolution.")
    current_limit: tuple[Positive, Positive] = setting(
        (6.0, 6.0), "A", "Maximum goal current; the servo's own limit also applies."
    )
    mode: Literal["current-based position", "current", "position"] = setting(
        "current-based position", "", "Operating mode of the servos; `position` cannot grasp."
    )
    stiffness: Positive = setting(
        8.0, "A/rad", "Position gain of the daemon's position loop in `current` mode."
    )
    damping: NonNegative = setting(
        0.4, "A·s/rad", "Velocity gain of the daemon's position loop in `current` mode."
    )
    reply_timeout: float = setting(
        0.004, "s", "Maximum time that the loop waits for a servo reply.", gt=0, le=1
    )
    open_timeout: Seconds = setting(
        5.0, "s", "Maximum time to wait at startup for servos that do not reply."
    )
    fault_after: Seconds = setting(
        0.05, "s", "Time without a valid reading after which a fault is latched."
    )
    watchdog: float = setting(
        0.1, "s",
            "Time without any command after which a servo stops on its own; 0 disables the "
            "watchdog.", ge=0, le=2.54
    )  # fmt: skip
    heat_rise: NonNegative = setting(
        0.0, "K/A²", "Final case temperature rise per squared current; 0 selects the model's value."
    )
    heat_time: NonNegative = setting(
        0.0, "s", "Time constant of the case temperature; 0 selects the model's value."
    )


class TactileSettings(Section):
    """The pressure sensors under the tips."""

    backend: Annotated[str, names_backend("tactile")] = setting(
        "simulated", "", "Source of the frames.", examples=[*BUILT_IN["tactile"]]
    )
    port: tuple[str, str] = setting(
        ("/dev/ttyUSB1", "/dev/ttyUSB2"), "",
        'Serial ports; "{dir}" is replaced by the folder given with --dir.'
    )  # fmt: skip
    baud: int = setting(
        2_000_000, "bit/s", "Baud rate of the serial ports.", ge=9600, le=12_000_000
    )
    rows: int = setting(44, "", "Number of rows (cells along y).", ge=4, le=256)
    cols: int = setting(44, "", "Number of columns (cells along x).", ge=4, le=256)
    pitch: float = setting(
        0.058 / 44, "m", "Distance between the column centres.", ge=1e-4, le=0.05
    )
    pitch_y: float = setting(
        0.0, "m", "Distance between the row centres; 0 selects the value of `pitch`.", ge=0, le=0.05
    )
    centre: tuple[Place, Place] = setting(
        (0.0, 0.0), "m", "Position (x, y) of the tip's centre relative to the grid's centre."
    )
    rotation: tuple[Angle, Angle] = setting(
        (0.0, 0.0), "rad", "Rotation of each sensor relative to its finger, about +z."
    )
    blur: float = setting(
        0.0, "m", "Standard deviation of the blur due to the layer above the cells.", ge=0, le=0.01
    )
    dead: tuple[Cells, Cells] = setting(((), ()), "", "Ignored cells [row, col] of each sensor.")
    threshold: int = setting(
        0,
        "counts",
        "Minimum nonzero count of the board, which sends smaller counts as 0.",
        ge=0,
        le=255,
    )
    pascal_per_count: Positive = setting(4.0, "Pa", "Pressure that corresponds to one count.")
    full_count: int = setting(
        65535, "counts", "Count at which a cell is saturated.", ge=1, le=65535
    )
    rate: Rate = setting(100.0, "Hz", "Expected frame rate.")
    noise: Positive = setting(
        1520.0, "Pa", "Noise standard deviation of each cell (default: 0.5 % of 0.304 MPa)."
    )
    baseline_error: NonNegative = setting(
        0.0, "Pa", "Standard deviation of the zero shift since the last tare, common to all cells."
    )
    slope_error: NonNegative = setting(
        0.0, "Pa",
            "Standard deviation of a zero offset that increases linearly from the tip's centre "
            "to its rim, in x and in y."
    )  # fmt: skip
    centre_error: float = setting(
        0.0, "m", "Standard deviation of `centre`, in x and in y.", ge=0, le=0.01
    )
    pitch_error: float = setting(0.0, "", "Relative standard deviation of the pitch.", ge=0, le=0.1)
    rotation_error: float = setting(0.0, "rad", "Standard deviation of `rotation`.", ge=0, le=0.5)
    # Crosstalk is below 3.3 % with a good read-out circuit (arXiv 2508.20959). Linearity is ± 3 %
    # (FlexiForce manual).
    smooth_error: float = setting(
        0.035, "", "Relative standard deviation of pressure errors that neighbouring cells share, "
        "for example crosstalk and hysteresis.", ge=0, le=1
    )  # fmt: skip
    gain_error: float = setting(
        0.25, "", "Relative standard deviation of the sensor's gain.", gt=0, le=1
    )
    latency: Delay = setting(
        0.02, "s", "Time from the middle of a scan to the arrival of the frame's first byte."
    )
    response: Delay = setting(
        0.0,
        "s",
        "Time constant of the cells' first-order lag, which the estimator compensates for.",
    )
    open_timeout: Seconds = setting(5.0, "s", "Maximum time to wait for the first valid frame.")
    sensor: tuple[str, str] = setting(
        ("", ""), "", "Sensor names, such as serial numbers, which are stored in calibration files."
    )
    calibration: tuple[str, str] = setting(
        ("", ""),
        "",
        "Calibration files created by `softfinger calibrate`; their values override the "
        "settings above.",
    )
    recording: tuple[str, str] = setting(
        ("", ""), "", 'Recordings for backend = "replay": an .npz file, a folder of .npy files, or '
        "an ASCII export."
    )  # fmt: skip
    replay_again: bool = setting(
        True, "", 'With backend = "replay": repeat the recording when it ends.'
    )

    @property
    def pitches(self) -> tuple[float, float]:
        """Distances between column centres and between row centres [m]."""
        return self.pitch, self.pitch_y or self.pitch


class EstimatorSettings(Section):
    """Estimation of displacement and tilt from a frame."""

    free_gain: Literal["auto", True, False] = setting(
        "auto", "",
            "Estimate the sensor gain from each frame. `auto` estimates the gain for springs only, "
            "because the frames of a solid tip do not determine both d and the gain."
    )  # fmt: skip


class LoopSettings(Section):
    """The control loop and its clock.

    The ``real`` clock is the machine's clock. The ``hand`` clock of a simulated hand pauses while
    the machine is busy. The ``virtual`` clock runs as fast as possible. ``hand`` and ``virtual``
    need simulated backends. ``auto`` selects ``hand`` for simulated backends and for the ports of
    `softfinger emulate`, otherwise ``real``.
    """

    rate: float = setting(500.0, "Hz", "Rate of the control loop.", ge=10, le=5000)
    clock: Literal["auto", "hand", "real", "virtual"] = setting(
        "auto", "", "Clock used by the loop."
    )


class RealtimeSettings(Section):
    """Real-time features that reduce the delay of ticks.

    The daemon reports the features that the system denies.

    All features are harmless except the priority: under SCHED_FIFO, the loop can block other
    programs on its processor.
    """

    priority: int = setting(0, "", "SCHED_FIFO priority; 0 keeps normal scheduling.", ge=0, le=80)
    slice: float = setting(
        1e-4, "s",
            "Scheduler time slice. A process with a short slice is scheduled sooner. 0 keeps the "
            "default.",
        ge=0, le=0.1
    )  # fmt: skip
    cpus: tuple[Processor, ...] = setting(
        (), "", "Processors that the loop may use; an empty list allows all processors."
    )
    lock_memory: bool = setting(True, "", "Prevent the process memory from being swapped out.")
    hold_latency: bool = setting(
        True, "", "Keep the processors out of deep idle states, from which they wake up slowly."
    )
    timer_slack: float = setting(
        1e-9, "s", "Timer slack; 0 keeps the default, usually 50 µs.", ge=0, le=1e-3
    )
    freeze_collector: bool = setting(
        True, "",
            "Exclude objects created at startup from garbage collection, which would otherwise "
            "pause the loop for tens of milliseconds."
    )  # fmt: skip
    spin: float = setting(
        5e-5,
        "s",
        "Time before each tick during which the loop waits without sleeping.",
        ge=0,
        le=1e-3,
    )


class StreamSettings(Section):
    """The published stream.

    A topic is sent on every n-th tick; n is chosen so that the rate is closest to the setting.
    """

    address: str = setting(STREAM_ADDRESS, "", "Address of the stream, tcp or ipc.")
    latest: str = setting(
        "", "",
            "Address on which each state is also sent as a single frame, for `ZMQ_CONFLATE`. "
            "If empty, states are sent only at `address`."
    )  # fmt: skip
    state_rate: Rate = setting(100.0, "Hz", "Rate of `hand/state`.")
    tactile_rate: Rate = setting(
        100.0, "Hz", "Rate at which the tactile frames of each finger are sent."
    )
    tactile_unit: Literal["count", "Pa"] = setting(
        "count", "", "Send raw counts, or the pressures used by the estimator."
    )
    queue: int = setting(
        2000,
        "messages",
        "Maximum number of messages queued for a slow subscriber.",
        ge=1,
        le=100_000,
    )


class CommandSettings(Section):
    """The command server."""

    address: str = setting(COMMAND_ADDRESS, "", "Address of the command server, tcp or ipc.")
    lease: Seconds = setting(
        2.0, "s", "Time for which a client keeps control of the hand after its last command."
    )
    on_silence: Literal["hold", "release", "stop"] = setting(
        "hold", "", "Action when the lease of the client in control expires, or when a task fails."
    )
    max_bytes: int = setting(4096, "bytes", "Maximum size of a command.", ge=64, le=65_536)
    per_second: float = setting(
        200.0, "Hz", "Maximum command rate of one client; `stop` is always accepted.",
        ge=1, le=10_000
    )  # fmt: skip


class AccessSettings(Section):
    """Access to stream and commands. Keys are required if other machines can reach an address."""

    keys: str = setting(
        "",
        "",
        "Folder created by `softfinger keys`. Both sockets then accept only clients with a key in "
        "this folder.",
    )
    ipc_mode: Literal["0600", "0660", "0666"] = setting("0600", "", "File mode of an ipc address.")


class ControlSettings(Section):
    """Gains and rates of the control laws. The defaults were chosen in simulation."""

    torque_constant: Factor = setting(
        1.78, "N·m/A", "Joint torque per motor current (XM430-W350: 4.1 N·m at 2.3 A)."
    )
    torque_error: float = setting(
        0.1, "", "Relative standard deviation of the torque constant.", gt=0, le=1
    )
    approach_speed: Positive = setting(0.3, "rad/s", "Joint speed when closing on an object.")
    approach_current: Positive = setting(
        0.15, "A", "Maximum current when closing; it bounds the tip force if a sensor fails."
    )
    move_speed: Positive = setting(1.0, "rad/s", "Joint speed during `move` and `release`.")
    contact_force: Positive = setting(0.5, "N", "Force above which a finger is in contact.")
    force_default: Positive = setting(5.0, "N", "Force of a `grasp` without the `force` parameter.")
    law: Literal["energy", "upright"] = setting(
        "energy", "", "Grip control law; `upright` does not use the measured object angle."
    )
    force_time: Seconds = setting(
        0.1, "s", "Duration of the force ramp from the measured to the commanded value."
    )
    smooth_time: Seconds = setting(
        0.1, "s", "Averaging time of the setpoints; averaging limits the jerk of the setpoints."
    )
    force_gain: NonNegative = setting(1.0, "", "Proportional gain of the force controller.")
    force_bandwidth: NonNegative = setting(1.0, "Hz", "Bandwidth of the force integral.")
    rotate_speed: Positive = setting(1.3, "rad/s", "Rotation speed of the object in `rotate`.")
    rotate_bandwidth: NonNegative = setting(4.0, "Hz", "Bandwidth of the angle integral.")
    joint_stiffness: Positive = setting(
        45.0, "N·m/rad", "Stiffness of the position loop for antisymmetric joint motion."
    )
    dither_torque: NonNegative = setting(
        0.3, "N·m", "Amplitude of the antisymmetric dither torque with which `upright` overcomes "
        "joint friction."
    )  # fmt: skip
    dither_frequency: float = setting(
        5.0, "Hz", "Dither frequency; lower frequencies would make the grip swing.", ge=3, le=50
    )
    dither_time: Delay = setting(2.0, "s", "Duration of the dither, whose amplitude falls to 0.")
    joint_inertia: Factor = setting(
        0.010, "kg·m²", "Inertia of the finger and the rotor, used to compute the damping."
    )
    damping_ratio: NonNegative = setting(
        0.7,
        "",
        "Damping ratio of the joint's oscillation against the stiffness of the tips and the "
        "position loop.",
    )
    joint_friction: NonNegative = setting(
        0.05, "N·m", "Coulomb friction that is compensated while the joint is commanded to move."
    )
    joint_load_friction: float = setting(
        0.0, "", "Gear friction as a fraction of the transmitted torque (MX-64 0.23, XL330 0.25).",
        ge=0, le=0.5
    )  # fmt: skip
    friction_speed: Positive = setting(
        0.02, "rad/s", "Commanded speed above which friction is fully compensated."
    )
    tip_friction: Positive = setting(0.6, "", "Assumed Coulomb friction coefficient of the tip.")
    slip_margin: Fraction = setting(0.2, "", "Fraction of `tip_friction` that is kept in reserve.")
    object_load: NonNegative = setting(
        0.0, "N", "Known load along the object's faces, usually its weight."
    )
    grip_raise_max: NonNegative = setting(
        10.0, "N", "Maximum grip force increase that counteracts slip."
    )
    grip_raise_share: NonNegative = setting(
        1.0,
        "",
        "Maximum grip force increase as a fraction of the commanded force; the smaller of "
        "the two bounds applies.",
    )
    envelope: str = setting(
        "", "",
            "Map created by `softfinger envelope --keep`, against which `grasp` is checked. If "
            "empty, the packaged map is used."
    )  # fmt: skip

    @property
    def driving(self) -> float:
        """Ratio of motor torque to tip torque while the joint closes, (1 + μ)/(1 − μ).

        The gears lose a fraction μ of each torque to friction. While the joint opens, the ratio is
        inverted.
        """
        return (1.0 + self.joint_load_friction) / (1.0 - self.joint_load_friction)

    @property
    def load_held(self) -> float:
        """Fraction of the tip moment that gear friction can balance before the joint opens."""
        return 1.0 - self.driving**-2


class SafetySettings(Section):
    """Safety limits. Goals are clipped to their limits; exceeding a fault limit latches a fault."""

    current_max: Positive = setting(1.2, "A", "Maximum goal current.")
    current_move: Positive = setting(0.4, "A", "Maximum goal current outside a grip.")
    force_max: Positive = setting(30.0, "N", "Normal tip force above which a fault is latched.")
    d_max: Length = setting(0.012, "m", "Tip displacement above which a fault is latched.")
    theta_margin: float = setting(
        0.05, "rad", "Distance between |θ| and the contact model's limit, below which a fault is "
        "latched.",
        ge=0, le=1
    )  # fmt: skip
    velocity_max: Positive = setting(6.0, "rad/s", "Joint speed above which a fault is latched.")
    frame_age_hold: Positive = setting(
        3.0, "frame periods", "Frame age above which the goal is frozen."
    )
    frame_age_fault: Positive = setting(
        10.0, "frame periods", "Frame age above which a fault is latched."
    )
    frame_age_action: Literal["torque off", "open"] = setting(
        "torque off", "", "Reaction to a `tactile.silent` fault; `open` opens the hand first."
    )
    goal_reach: Positive = setting(
        0.5,
        "rad",
        "Distance from the current joint angle within which the goal may jump in one step.",
    )
    goal_speed: Positive = setting(
        3.0, "rad/s", "Maximum speed of the goal angle outside `goal_reach`."
    )
    current_rate: Positive = setting(60.0, "A/s", "Maximum rate at which a goal current increases.")
    current_fault: Positive = setting(
        1.8, "A", "Measured current above which a fault is latched after 0.1 s."
    )
    stall_error: Positive = setting(
        0.1,
        "rad",
        "Distance from the goal beyond which a stationary joint at maximum current counts "
        "as stalled.",
    )
    stall_time: Seconds = setting(2.0, "s", "Duration of a stall after which a fault is latched.")
    temperature_max: Positive = setting(
        70.0, "°C", "Servo temperature above which a fault is latched."
    )
    heat_warn: Positive = setting(
        60.0, "s", "Predicted time to reach `temperature_max`, below which the daemon warns and "
        "reduces the grip force."
    )  # fmt: skip
    heat_action: Literal["hold", "release", "stop"] = setting(
        "hold", "", "Action against overheating if the load does not allow a lower grip force."
    )
    voltage_min: NonNegative = setting(
        0.0, "V", "Minimum supply voltage of a servo; 0 selects the model's limit."
    )
    voltage_max: NonNegative = setting(
        0.0, "V", "Maximum supply voltage of a servo; 0 selects the model's limit."
    )
    residual_angle: Positive = setting(
        0.2, "rad",
            "Difference between the object angles measured by the two fingers, above which a "
            "fault is latched."
    )  # fmt: skip
    residual_width: Positive = setting(
        0.004, "m", "Change in the held object's width since the grip began, above which a fault "
        "is latched."
    )  # fmt: skip
    residual_force: Positive = setting(
        0.5, "", "Relative difference between the tip forces, above which a warning is issued."
    )
    saturated: Fraction = setting(
        0.05, "", "Fraction of saturated cells above which a warning is issued."
    )
    frozen_after: Delay = setting(
        0.5,
        "s",
        "Duration of identical frames during contact after which a fault is latched; 0 "
        "disables the check.",
    )
    overruns_fault: int = setting(
        100, "ticks", "Number of consecutive late ticks after which a fault is latched.", ge=1
    )


class ObjectSettings(Section):
    """Assumptions about the object."""

    width: Length = setting(0.040, "m", "Distance between the object's faces.")
    taper: float = setting(
        0.0, "rad", "Angle between the object's faces; positive if the object widens towards the "
        "palm.",
        ge=-1.5, le=1.5
    )  # fmt: skip
    width_min: NonNegative = setting(
        0.002,
        "m",
        "Distance between the tips, below which the grip counts as empty and the hand opens.",
    )


class TaskSettings(Section):
    """A task that the daemon runs without a client."""

    name: Literal["none", "demo"] = setting("none", "", "Name of the task.")
    force: Positive = setting(8.0, "N", "Mean tip force.")
    angle: Angle = setting(0.14, "rad", "Angle by which the object is rotated to either side.")


class PluginSettings(Section):
    """Settings of plugins: one table ``[plugins.NAME]`` for each plugin that has settings."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)

    @property
    def tables(self) -> dict[str, Any]:
        """The profile's plugin tables by name."""
        return self.model_extra or {}


class Settings(Section):
    """A softfinger profile. The defaults describe the built-in simulated hand."""

    scene: SceneSettings = SceneSettings()
    hand: GeometrySettings = GeometrySettings()
    tip: TipSettings = TipSettings()
    material: MaterialSettings = MaterialSettings()
    table: TableSettings = TableSettings()
    servos: ServoSettings = ServoSettings()
    tactile: TactileSettings = TactileSettings()
    estimator: EstimatorSettings = EstimatorSettings()
    loop: LoopSettings = LoopSettings()
    realtime: RealtimeSettings = RealtimeSettings()
    stream: StreamSettings = StreamSettings()
    commands: CommandSettings = CommandSettings()
    access: AccessSettings = AccessSettings()
    control: ControlSettings = ControlSettings()
    safety: SafetySettings = SafetySettings()
    object: ObjectSettings = ObjectSettings()
    simulation: SimulationSettings = SimulationSettings()
    task: TaskSettings = TaskSettings()
    plugins: PluginSettings = PluginSettings()

    def changed(self, **sections: dict[str, Any]) -> Settings:
        """Return a copy with the given values of each section; the values are not validated."""
        return self.model_copy(
            update={
                name: getattr(self, name).model_copy(update=keys) for name, keys in sections.items()
            }
        )

    @property
    def simulated(self) -> bool:
        """True if the servos and sensors are not real hardware."""
        servos, tactile = self.servos.backend, self.tactile.backend
        return not (backend("servos", servos).metal or backend("tactile", tactile).metal)

    def ports(self, plugins: bool = True) -> list[tuple[str, str]]:
        """Return the key and the path of each port that the hand needs.

        If ``plugins`` is False, the ports of plugin backends are omitted.
        """
        servos = backend("servos", self.servos.backend)
        tactile = backend("tactile", self.tactile.backend)
        found = []
        if servos.metal and (plugins or not servos.source):
            found.append(("servos.port", self.servos.port))
        if tactile.metal and (plugins or not tactile.source):
            for name, port in zip(FINGERS, self.tactile.port, strict=True):
                if name in self.scene.fingers:
                    found.append((f"tactile.port ({name})", port))
        return found

    def addresses(self) -> dict[str, str]:
        """Return the addresses that the daemon binds, by key."""
        found = {"stream.address": self.stream.address, "commands.address": self.commands.address}
        return found | ({"stream.latest": self.stream.latest} if self.stream.latest else {})
