"""Define the sections of a profile, with defaults, bounds, units and meanings.

The defaults describe the built-in simulated hand. `profile.load` reads and validates a file.
`profile.reference` generates ``config/sim.toml`` and the JSON schema from these declarations. Pairs
are (left, right).
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
    GearLoss,
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
from softfinger.daemon.types import COMMAND_ADDRESS, STREAM_ADDRESS

Finger = Literal["left", "right"]
Cells = tuple[tuple[Index, Index], ...]
LawName = Literal["energy", "upright"]
ServoMode = Literal["current-based position", "current", "position"]


class SceneSettings(Section):
    """Parts of the hand that are used. The backend ``none`` removes the servos or the sensors."""

    fingers: tuple[Finger, ...] = setting(
        ("left", "right"), "", "The fingers of the hand, one or two.", min_length=1, max_length=2
    )
    object_model: bool = setting(
        True, "", "Estimate the object's angle and width from both contacts."
    )


class GeometrySettings(Section):
    """Two rotational fingers in a plane: pivots at (∓pivot_separation/2, 0), q > 0 closes."""

    pivot_separation: Length = setting(0.100, "m", "Distance between the axes of the two joints.")
    finger_length: Length = setting(
        0.080, "m", "Distance from the axis to the centre of the tip's base, along the finger."
    )
    finger_offset: Place = setting(
        0.0, "m", "The same distance across the finger, positive towards the other finger."
    )
    q_min: tuple[Angle, Angle] = setting((-0.5, -0.5), "rad", "Joint angle of the widest opening.")
    q_max: tuple[Angle, Angle] = setting((1.0, 1.0), "rad", "Largest joint angle when closing.")
    open_angle: tuple[Angle, Angle] = setting(
        (0.0, 0.0), "rad", "Joint angle that `release` moves to."
    )


class TipSettings(Section):
    """The soft hemispherical fingertip: the paper's springs, solid rubber, or measured curves.

    `calibrate law` measures the curves and stores them in the files of ``tactile.calibration``.
    """

    radius: Length = setting(0.020, "m", "Radius of the hemisphere.")
    physics: Literal["springs", "solid", "measured"] = setting(
        "springs", "", "Contact model: the paper's springs, solid rubber, or measured curves."
    )
    poisson: float = setting(0.49, "", "Poisson's ratio of a solid tip.", ge=0.45, le=0.4995)
    base: Literal["bonded", "lying"] = setting(
        "bonded", "", "Base of a solid tip: bonded to the sensor, or lying on it and free to slide."
    )
    face: Literal["frictionless", "sticking"] = setting(
        "frictionless", "", "Contact of a solid tip with the object."
    )
    relaxation: tuple[Fraction, Fraction, Fraction] = setting(
        (0.0, 0.0, 0.0), "", "Amplitudes of three Prony terms: shares of its final stiffness by "
        "which the tip is firmer at first."
    )  # fmt: skip
    relaxation_times: tuple[Positive, Positive, Positive] = setting(
        (0.004, 0.07, 1.4), "s", "Time constants of the Prony terms; the defaults are those of a "
        "human fingerpad (Pawluk & Howe, 1999)."
    )  # fmt: skip


class MaterialSettings(Section):
    """Stress-strain law of the tip: the paper's Table I, a constant modulus, or measured points."""

    law: Literal["table_i", "constant", "points"] = setting("table_i", "", "Stress-strain law.")
    modulus: Modulus = setting(0.304e6, "Pa", 'Modulus for law = "constant".')
    strain: tuple[Finite, ...] = setting((), "", 'Strains of the points for law = "points".')
    stress: tuple[Finite, ...] = setting((), "Pa", 'Stresses of the points for law = "points".')
    modulus_error: float = setting(
        0.0, "", "Relative standard deviation of the modulus.", ge=0, le=1
    )
    force_error_max: Positive = setting(
        0.05, "", "Largest relative error of the force that the fit of the points may cause at "
        "d > radius/20; a larger one is an error."
    )  # fmt: skip


class TableSettings(Section):
    """The contact table, a lookup of force, energy and their partial derivatives."""

    tolerance: float = setting(
        1e-9, "", "Largest relative error of the looked-up values.", ge=1e-9, le=1e-2
    )


class ServoSettings(Section):
    """The servos of the joints."""

    backend: Annotated[str, names_backend("servos")] = setting(
        "simulated", "", "Driver of the servos.", examples=[*BUILT_IN["servos"]]
    )
    port: str = setting(
        "/dev/ttyUSB0", "", 'Serial port. "{dir}" stands for the folder given by --dir.'
    )
    baud: int = setting(2_000_000, "bit/s", "Rate of the bus.", ge=9600, le=4_500_000)
    model: ServoModel = setting("XM430-W350", "", "Model of both servos.")
    ids: tuple[ServoId, ServoId] = setting((1, 2), "", "IDs of the servos on the bus.")
    direction: tuple[Literal[-1, 1], Literal[-1, 1]] = setting(
        (1, -1), "", "Sign of the change of the servo's counts when the finger closes."
    )
    zero: tuple[Counts, Counts] = setting((2048, 2048), "counts", "Servo position at q = 0.")
    gear_ratio: Positive = setting(1.0, "", "Turns of the servo for one turn of the joint.")
    current_limit: tuple[Positive, Positive] = setting(
        (6.0, 6.0), "A", "Upper bound of the goal current; the servo's own limit applies as well."
    )
    mode: ServoMode = setting(
        "current-based position", "", "Operating mode of the servos; `position` cannot grasp."
    )
    stiffness: Positive = setting(
        8.0, "A/rad", "Gain of the daemon's position loop in the mode `current`."
    )
    damping: NonNegative = setting(
        0.4, "A·s/rad", "Velocity gain of the daemon's position loop in the mode `current`."
    )
    reply_timeout: float = setting(
        0.004, "s", "Longest time that the loop waits for a servo's reply.", gt=0, le=1
    )
    open_timeout: Seconds = setting(
        5.0, "s", "Longest time to wait at the start for servos that do not answer."
    )
    fault_after: Seconds = setting(0.05, "s", "Time without a valid reading that is a fault.")
    watchdog: float = setting(
        0.1, "s", "Time without a command after which a servo stops by itself; 0 disables its "
        "watchdog.", ge=0, le=2.54
    )  # fmt: skip
    heat_rise: NonNegative = setting(
        0.0, "K/A²", "Final temperature rise of the servo's case; 0 stands for the model's value."
    )
    heat_time: NonNegative = setting(
        0.0, "s", "Time constant of that rise; 0 stands for the model's value."
    )


class TactileSettings(Section):
    """The pressure grids under the tips."""

    backend: Annotated[str, names_backend("tactile")] = setting(
        "simulated", "", "Source of the frames.", examples=[*BUILT_IN["tactile"]]
    )
    port: tuple[str, str] = setting(
        ("/dev/ttyUSB1", "/dev/ttyUSB2"), "",
        'Serial ports. "{dir}" stands for the folder given by --dir.'
    )  # fmt: skip
    baud: int = setting(2_000_000, "bit/s", "Rate of the serial ports.", ge=9600, le=12_000_000)
    rows: int = setting(44, "", "Number of rows (cells along y).", ge=4, le=256)
    cols: int = setting(44, "", "Number of columns (cells along x).", ge=4, le=256)
    pitch: float = setting(
        0.058 / 44, "m", "Distance between the centres of columns.", ge=1e-4, le=0.05
    )
    pitch_y: float = setting(
        0.0, "m", "Distance between the centres of rows; 0 stands for `pitch`.", ge=0, le=0.05
    )
    centre: tuple[Place, Place] = setting(
        (0.0, 0.0), "m", "Position (x, y) of the tip's centre relative to the grid's centre."
    )
    rotation: tuple[Angle, Angle] = setting(
        (0.0, 0.0), "rad", "Rotation of each sensor relative to its finger, about +z."
    )
    blur: float = setting(
        0.0, "m", "Standard deviation of the blur by the layer above the cells.", ge=0, le=0.01
    )
    dead: tuple[Cells, Cells] = setting(
        ((), ()), "", "Cells [row, col] of each sensor that are ignored."
    )
    threshold: int = setting(
        0, "counts", "Smallest count that the board sends; it sends 0 below.", ge=0, le=255
    )
    pascal_per_count: Positive = setting(4.0, "Pa", "Pressure of one count.")
    full_count: int = setting(
        65535, "counts", "Count at which a cell is saturated.", ge=1, le=65535
    )
    rate: Rate = setting(100.0, "Hz", "Expected rate of frames.")
    noise: Positive = setting(
        1520.0, "Pa", "Standard deviation of a cell's noise (default: 0.5 % of 0.304 MPa)."
    )
    baseline_error: NonNegative = setting(
        0.0, "Pa", "Standard deviation of a common shift of all cells since the last tare."
    )
    slope_error: NonNegative = setting(
        0.0, "Pa", "Standard deviation of a linear change of the zero from the tip's centre to its "
        "rim, in x and in y."
    )  # fmt: skip
    centre_error: float = setting(
        0.0, "m", "Standard deviation of `centre`, in x and in y.", ge=0, le=0.01
    )
    pitch_error: float = setting(0.0, "", "Relative standard deviation of the pitch.", ge=0, le=0.1)
    rotation_error: float = setting(0.0, "rad", "Standard deviation of `rotation`.", ge=0, le=0.5)
    # Crosstalk is below 3.3 % with a good read-out (arXiv 2508.20959), linearity ± 3 %
    # (FlexiForce's manual).
    smooth_error: float = setting(
        0.035, "", "Relative standard deviation of pressure errors that neighbouring cells share, "
        "as by crosstalk or hysteresis.", ge=0, le=1
    )  # fmt: skip
    gain_error: float = setting(
        0.25, "", "Relative standard deviation of the sensor's gain.", gt=0, le=1
    )
    latency: Delay = setting(
        0.02, "s", "Time from the middle of a scan to the arrival of the frame's first byte."
    )
    response: Delay = setting(
        0.0, "s", "Time constant of the cells' first-order lag; the estimate compensates for it."
    )
    open_timeout: Seconds = setting(5.0, "s", "Longest time to wait for the first valid frame.")
    sensor: tuple[str, str] = setting(
        ("", ""), "", "Names of the sensors, such as serial numbers; calibrations state them."
    )
    calibration: tuple[str, str] = setting(
        ("", ""), "", "Files of `softfinger calibrate`; their values replace those above."
    )
    recording: tuple[str, str] = setting(
        ("", ""), "", 'Frames for backend = "replay": an .npz file, a folder of .npy files, or an '
        "ASCII export."
    )  # fmt: skip
    replay_again: bool = setting(
        True, "", 'With backend = "replay": start again at the end of the recording.'
    )


class EstimatorSettings(Section):
    """Estimation of displacement and angle from a frame."""

    method: Literal["ml"] = setting("ml", "", "Estimator: maximum likelihood.")
    free_gain: Literal["auto", True, False] = setting(
        "auto", "", "Estimate the sensor's gain with each frame. `auto` does so for springs only: "
        "frames of a solid tip show d by the force alone, so its gain must be known."
    )  # fmt: skip


class LoopSettings(Section):
    """The control loop and its clock.

    ``real`` is the machine's time. ``hand`` is the time of a simulated hand, which waits while the
    machine is busy. ``virtual`` runs as fast as the machine can. ``hand`` and ``virtual`` need
    simulated backends. ``auto`` is ``hand`` with these and on the ports of `softfinger emulate`,
    otherwise ``real``.
    """

    rate: float = setting(500.0, "Hz", "Rate of the control loop.", ge=10, le=5000)
    clock: Literal["auto", "hand", "real", "virtual"] = setting("auto", "", "Clock of the loop.")


class RealtimeSettings(Section):
    """Measures for a punctual control loop. The daemon reports those that the system refuses.

    All are harmless except the priority: a loop at SCHED_FIFO keeps other programs off its
    processor.
    """

    priority: int = setting(
        0, "", "Priority under SCHED_FIFO; 0 keeps the usual scheduling.", ge=0, le=80
    )
    slice: float = setting(
        1e-4, "s", "Scheduler slice; short ones are scheduled sooner; 0 keeps the system's.",
        ge=0, le=0.1
    )  # fmt: skip
    cpus: tuple[Processor, ...] = setting(
        (), "", "Processors that the loop may use; an empty list allows all."
    )
    lock_memory: bool = setting(True, "", "Keep the process's memory from being swapped out.")
    hold_latency: bool = setting(
        True, "", "Keep the processors out of idle states that take long to leave."
    )
    timer_slack: float = setting(
        1e-9, "s", "Timer slack; 0 keeps the system's, usually 50 µs.", ge=0, le=1e-3
    )
    freeze_collector: bool = setting(
        True, "", "Exclude start-up objects from garbage collection, which would take tens of "
        "milliseconds."
    )  # fmt: skip
    spin: float = setting(
        5e-5, "s", "Time before each tick that the loop waits awake.", ge=0, le=1e-3
    )


class StreamSettings(Section):
    """The published stream. A topic is sent every n-th tick, with the n nearest to its rate."""

    address: str = setting(STREAM_ADDRESS, "", "Address of the stream, tcp or ipc.")
    latest: str = setting(
        "", "", "Address where each state is sent in one frame, for `ZMQ_CONFLATE`; empty: none."
    )
    state_rate: Rate = setting(100.0, "Hz", "Rate of the state.")
    tactile_rate: Rate = setting(100.0, "Hz", "Rate of each finger's frames.")
    tactile_unit: Literal["count", "Pa"] = setting(
        "count", "", "Send raw counts, or the pressures that the estimator uses."
    )
    queue: int = setting(2000, "messages", "Messages kept for a slow subscriber.", ge=1, le=100_000)


class CommandSettings(Section):
    """The command server."""

    address: str = setting(COMMAND_ADDRESS, "", "Address of the command server, tcp or ipc.")
    lease: Seconds = setting(
        2.0, "s", "Time that a client keeps control of the hand after its last command."
    )
    on_silence: Literal["hold", "release", "stop"] = setting(
        "hold", "", "Action when the client in control falls silent."
    )
    max_bytes: int = setting(4096, "bytes", "Longest command.", ge=64, le=65_536)
    per_second: float = setting(
        200.0, "Hz", "Rate of commands that one client may send; `stop` is always accepted.",
        ge=1, le=10_000
    )  # fmt: skip


class AccessSettings(Section):
    """Access to stream and commands. Addresses that other machines can reach need keys."""

    keys: str = setting(
        "", "", "Folder made by `softfinger keys`; both sockets then accept only its clients."
    )
    ipc_mode: Literal["0600", "0660", "0666"] = setting("0600", "", "File mode of an ipc address.")


class ControlSettings(Section):
    """Gains and rates of the control law; the defaults were chosen in simulation."""

    torque_constant: Factor = setting(
        1.78, "N·m/A", "Joint torque per current (XM430-W350: 4.1 N·m at 2.3 A)."
    )
    torque_error: float = setting(
        0.1, "", "Relative standard deviation of the torque constant.", gt=0, le=1
    )
    approach_speed: Positive = setting(0.3, "rad/s", "Joint speed when closing on an object.")
    approach_current: Positive = setting(
        0.15, "A", "Highest current when closing; it bounds the force of a tip whose sensor fails."
    )
    move_speed: Positive = setting(1.0, "rad/s", "Joint speed of `move` and `release`.")
    contact_force: Positive = setting(0.5, "N", "Force at which a finger counts as touching.")
    force_default: Positive = setting(5.0, "N", "Force of a `grasp` without force=.")
    law: LawName = setting("energy", "", "Grip law; `upright` does not measure the object's angle.")
    force_time: Seconds = setting(
        0.1, "s", "Time in which the force changes from the measured to the commanded value."
    )
    smooth_time: Seconds = setting(
        0.1, "s", "Time over which setpoints are averaged; it bounds their jerk."
    )
    force_gain: NonNegative = setting(1.0, "", "Proportional gain of the force controller.")
    force_bandwidth: NonNegative = setting(1.0, "Hz", "Bandwidth of the force integral.")
    rotate_speed: Positive = setting(1.3, "rad/s", "Speed of the object's angle in `rotate`.")
    rotate_bandwidth: NonNegative = setting(4.0, "Hz", "Bandwidth of the angle integral.")
    joint_stiffness: Positive = setting(
        45.0, "N·m/rad", "Stiffness of the position loop on the antisymmetric joint motion."
    )
    dither_torque: NonNegative = setting(
        0.3, "N·m", "Antisymmetric torque by which `upright` overcomes joint friction."
    )
    dither_frequency: float = setting(
        5.0, "Hz", "Frequency of that torque; a lower one would swing the grip.", ge=3, le=50
    )
    dither_time: Delay = setting(2.0, "s", "Time in which that torque fades.")
    joint_inertia: Factor = setting(
        0.010, "kg·m²", "Inertia of finger and rotor that the damping is computed from."
    )
    damping_ratio: NonNegative = setting(
        0.7, "", "Damping ratio of that inertia on the stiffness of tips and position loop."
    )
    joint_friction: NonNegative = setting(
        0.05, "N·m", "Coulomb friction that is compensated while the joint is to move."
    )
    joint_load_friction: GearLoss = setting(
        0.0, "", "Gear friction as a share of the gears' torque (MX-64 0.23, XL330 0.3)."
    )
    friction_speed: Positive = setting(
        0.02, "rad/s", "Commanded speed from which on friction is fully compensated."
    )
    tip_friction: Positive = setting(0.6, "", "Assumed Coulomb coefficient of tip on object.")
    slip_margin: Fraction = setting(0.2, "", "Share of that friction that is kept in reserve.")
    object_load: NonNegative = setting(
        0.0, "N", "Known load along the faces of the tips, usually the object's weight."
    )
    grip_raise_max: NonNegative = setting(
        10.0, "N", "Largest increase of the grip force against slip."
    )
    grip_raise_share: NonNegative = setting(
        1.0, "", "Largest increase as a share of the commanded force; the smaller bound applies."
    )
    envelope: str = setting(
        "", "", "File of `softfinger envelope --keep`, which `grasp` is checked with; empty: the "
        "built-in hand's."
    )  # fmt: skip

    @property
    def driving(self) -> float:
        """Ratio of motor torque to tip torque while the joint closes, (1 + μ)/(1 − μ).

        Gears transmit both torques, and a fraction μ of each is lost to friction. The ratio is
        inverted while the joint opens.
        """
        return (1.0 + self.joint_load_friction) / (1.0 - self.joint_load_friction)

    @property
    def load_held(self) -> float:
        """Fraction of a tip's moment that gear friction holds before the joint opens."""
        return 1.0 - self.driving**-2


class SafetySettings(Section):
    """Limits. The goal is kept within them; crossing a hard limit latches a fault."""

    current_max: Positive = setting(1.2, "A", "Highest goal current.")
    current_move: Positive = setting(0.4, "A", "Highest goal current while nothing is grasped.")
    force_max: Positive = setting(30.0, "N", "Normal force of a tip that is a fault.")
    d_max: Length = setting(0.012, "m", "Displacement of a tip that is a fault.")
    theta_margin: float = setting(
        0.05, "rad", "Margin of |θ| from the limit of the contact model that is a fault.",
        ge=0, le=1
    )  # fmt: skip
    velocity_max: Positive = setting(6.0, "rad/s", "Joint speed that is a fault.")
    frame_age_hold: Positive = setting(
        3.0, "frame periods", "Age of the last frame from which on the goal is not moved."
    )
    frame_age_fault: Positive = setting(
        10.0, "frame periods", "Age of the last frame that is a fault."
    )
    frame_age_action: Literal["torque off", "open"] = setting(
        "torque off", "", "Reaction to such a fault; `open` opens the hand first."
    )
    goal_reach: Positive = setting(
        0.5, "rad", "Distance from the present joint angle within which the goal may jump."
    )
    goal_speed: Positive = setting(3.0, "rad/s", "Speed of a goal that is further away.")
    current_rate: Positive = setting(60.0, "A/s", "Fastest rise of a goal current.")
    current_fault: Positive = setting(
        1.8, "A", "Measured current that is a fault if it lasts for 0.1 s."
    )
    stall_error: Positive = setting(
        0.1, "rad", "Distance from the goal, at the highest current, of a stalled joint."
    )
    stall_time: Seconds = setting(2.0, "s", "Duration of a stall that is a fault.")
    temperature_max: Positive = setting(70.0, "°C", "Servo temperature that is a fault.")
    heat_warn: Positive = setting(
        60.0, "s", "Predicted time to that fault at which the daemon warns and eases the grip."
    )
    heat_action: Literal["hold", "release", "stop"] = setting(
        "hold", "", "Action if the load does not allow an eased grip."
    )
    voltage_min: NonNegative = setting(
        0.0, "V", "Lowest supply voltage of a servo; 0 stands for the model's limit."
    )
    voltage_max: NonNegative = setting(
        0.0, "V", "Highest supply voltage of a servo; 0 stands for the model's limit."
    )
    residual_angle: Positive = setting(
        0.2, "rad", "Difference of the object's angles by the two fingers that is a fault."
    )
    residual_width: Positive = setting(
        0.004, "m", "Change of the held object's width since the grip that is a fault."
    )
    residual_force: Positive = setting(
        0.5, "", "Relative difference of the two tips' forces that is reported."
    )
    saturated: Fraction = setting(0.05, "", "Share of saturated cells that is reported.")
    frozen_after: Delay = setting(
        0.5, "s", "Time of identical frames during contact that is a fault; 0: never."
    )
    overruns_fault: int = setting(100, "ticks", "Consecutive late ticks that are a fault.", ge=1)


class ObjectSettings(Section):
    """Assumptions about the object."""

    width: Length = setting(0.040, "m", "Distance between its faces.")
    taper: float = setting(
        0.0, "rad", "Angle between its faces; positive if it is wider at the palm.",
        ge=-1.5, le=1.5
    )  # fmt: skip
    width_min: NonNegative = setting(
        0.002, "m", "Distance of the tips below which they hold nothing, and the hand opens."
    )


class TaskSettings(Section):
    """A task that the daemon starts by itself."""

    name: Literal["none", "demo"] = setting("none", "", "The task.")
    force: Positive = setting(8.0, "N", "Mean force of the tips.")
    angle: Angle = setting(0.14, "rad", "Rotation of the object to either side.")


class PluginSettings(Section):
    """A table for each plugin that has settings of its own, ``[plugins.NAME]``."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of the plugins by name, as in the profile."""
        return self.model_extra or {}


class Settings(Section):
    """A profile of softfinger. The defaults are the built-in simulated hand."""

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

    @property
    def simulated(self) -> bool:
        """True if neither servos nor sensors are real hardware."""
        servos, tactile = self.servos.backend, self.tactile.backend
        return not (backend("servos", servos).metal or backend("tactile", tactile).metal)
