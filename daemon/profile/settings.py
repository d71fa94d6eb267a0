"""Settings: the sections of a profile, with their defaults, bounds and units.

Nothing here acts on them; `profile.load` reads and checks a file. The defaults alone are the
built-in simulated hand; ``config/sim.toml`` spells them out. Lengths are m, angles rad, currents A,
rates Hz; pairs are (left, right).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from softfinger.daemon.backends import Kind, backend, known, known_servo_models
from softfinger.daemon.errors import PluginError
from softfinger.daemon.types import COMMAND_ADDRESS, STREAM_ADDRESS

# Every number has an end on both sides: implausible values are typing errors, and must not reach
# an integral. Bounds are closed or open as the quantity is.
Positive = Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
_METRES = {"unit": "m"}  # by which a report knows lengths that seem to be in mm
Length = Annotated[float, Field(ge=1e-4, le=1, allow_inf_nan=False, json_schema_extra=_METRES)]
Place = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]  # m
Angle = Annotated[float, Field(ge=-6.3, le=6.3, allow_inf_nan=False)]  # rad
Seconds = Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)]
Delay = Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]  # s
Rate = Annotated[float, Field(ge=0.1, le=10_000, allow_inf_nan=False)]  # Hz
Acceleration = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]  # m/s²
Factor = Annotated[float, Field(ge=1e-5, le=1e5, allow_inf_nan=False)]
Counts = Annotated[int, Field(ge=-1_048_575, le=1_048_575)]
Modulus = Annotated[float, Field(ge=1, le=1e10, allow_inf_nan=False)]  # Pa
Fraction = Annotated[float, Field(ge=0, le=1)]
Ratio = Annotated[float, Field(ge=0.1, le=10)]
GearLoss = Annotated[float, Field(ge=0, le=0.5)]
Finger = Literal["left", "right"]
Index = Annotated[int, Field(ge=0, le=255)]
Cells = tuple[tuple[Index, Index], ...]
LawName = Literal["energy", "upright"]
ServoMode = Literal["current-based position", "current", "position"]


def _backend(kind: Kind) -> AfterValidator:
    """A text that names a backend, in pydantic's words for a Literal."""

    def check(name: str) -> str:
        try:
            backend(kind, name)
        except PluginError as error:
            why = {"why": str(error)}
            raise PydanticCustomError("plugin", "a plugin that works: {why}", why) from None
        except KeyError:
            *most, last = map(repr, known(kind))
            listed = {"known": f"{', '.join(most)} or {last}"}
            raise PydanticCustomError("one_of", "Input should be {known}", listed) from None
        return name

    return AfterValidator(check)


def _servo_model(name: str) -> str:
    if models := known_servo_models(name):
        raise PydanticCustomError("servo_model", "one of {known}", {"known": models})
    return name


Model = Annotated[str, AfterValidator(_servo_model)]


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values are not converted, nothing changes.

    A whole number is accepted where a float is asked for; a string never is.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SceneSettings(Section):
    """Parts that take part. A backend set to ``none`` takes the servos or the sensors out."""

    # one or two
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, max_length=2)] = ("left", "right")
    object_model: bool = True  # estimate the object's angle and width from the two contacts


class GeometrySettings(Section):
    """Two rotational fingers in a plane: pivots at (∓pivot_separation/2, 0), q > 0 closes."""

    pivot_separation: Length = 0.100  # m between the fingers' axes
    finger_length: Length = 0.080  # m, axis to the centre of the tip's base, along the finger
    finger_offset: Place = 0.0  # m, the same across the finger; positive towards the other one
    q_min: tuple[Angle, Angle] = (-0.5, -0.5)  # rad, as far as it opens
    q_max: tuple[Angle, Angle] = (1.0, 1.0)  # rad, as far as it closes
    open_angle: tuple[Angle, Angle] = (0.0, 0.0)  # where release goes


class TipSettings(Section):
    """The soft hemispherical fingertip: the paper's springs, solid rubber, or curves of its own.

    Those are measured by `calibrate law` and stand in the files of ``tactile.calibration``.
    """

    radius: Length = 0.020  # m
    radius_error: Annotated[float, Field(ge=0, le=0.1)] = 0.0  # relative, standard deviation
    physics: Literal["springs", "solid", "measured"] = "springs"  # the contact model
    poisson: Annotated[float, Field(ge=0.45, le=0.4995)] = 0.49  # of a solid tip
    base: Literal["bonded", "lying"] = "bonded"  # a solid tip on its sensor
    face: Literal["frictionless", "sticking"] = "frictionless"  # a solid tip on the object
    # how much firmer it is at once than in the end, by each of three Prony terms
    relaxation: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    # s, of each: a human fingerpad's (Pawluk & Howe, 1999)
    relaxation_times: tuple[Positive, Positive, Positive] = (0.004, 0.07, 1.4)


class MaterialSettings(Section):
    """Stress-strain law of the tip: the paper's Table I, a constant modulus, or measured points."""

    law: Literal["table_i", "constant", "points"] = "table_i"  # stress over strain
    modulus: Modulus = 0.304e6  # Pa, for law = "constant"
    strain: tuple[Finite, ...] = ()  # 1, for law = "points"
    stress: tuple[Finite, ...] = ()  # Pa, for law = "points"
    modulus_error: Annotated[float, Field(ge=0, le=1)] = 0.0  # relative, standard deviation
    force_error_max: Positive = 0.05  # of F, by the law's misfit of its points, d > radius/20


class TableSettings(Section):
    """The contact table: largest relative error of force, energy and their partials."""

    tolerance: Annotated[float, Field(ge=1e-13, le=1e-2)] = 1e-9  # relative


class ServoSettings(Section):
    """The joints."""

    backend: Annotated[str, _backend("servos")] = "simulated"  # what drives the joints
    port: str = "/dev/ttyUSB0"  # "{dir}" stands for the folder given by --dir
    baud: Annotated[int, Field(ge=9600, le=4_500_000)] = 2_000_000  # bit/s
    model: Model = "XM430-W350"  # of both servos
    # on the bus, each another
    ids: tuple[Annotated[int, Field(ge=0, le=252)], Annotated[int, Field(ge=0, le=252)]] = (1, 2)
    direction: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, -1)  # sign of counts when closing
    zero: tuple[Counts, Counts] = (2048, 2048)  # counts at q = 0
    gear_ratio: Positive = 1.0  # servo turns for one joint turn
    current_limit: tuple[Positive, Positive] = (6.0, 6.0)  # A; the servo's own limit binds too
    mode: ServoMode = "current-based position"  # or "current", or "position" (can't grasp)
    stiffness: Positive = 8.0  # A/rad of the daemon's position loop, in current mode alone
    damping: NonNegative = 0.4  # A·s/rad, likewise
    reply_timeout: Annotated[float, Field(gt=0, le=1)] = 0.004  # s, a missing reply costs no more
    open_timeout: Seconds = 5.0  # s to wait at the start for servos that do not answer yet
    fault_after: Seconds = 0.05  # s without a good reading → fault
    watchdog: Annotated[float, Field(ge=0, le=2.54)] = 0.1  # s, the servo's own; 0 leaves it off
    heat_rise: NonNegative = 0.0  # K/A² that its case warms by in the end; 0: the model's own
    heat_time: NonNegative = 0.0  # s in which it does, likewise


class TactileSettings(Section):
    """The pressure grids under the tips."""

    backend: Annotated[str, _backend("tactile")] = "simulated"  # where frames come from
    port: tuple[str, str] = ("/dev/ttyUSB1", "/dev/ttyUSB2")  # "{dir}" as for the servos
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 2_000_000  # bit/s
    rows: Annotated[int, Field(ge=4, le=256)] = 44  # cells along y
    cols: Annotated[int, Field(ge=4, le=256)] = 44  # cells along x
    pitch: Annotated[Length, Field(le=0.05)] = 0.058 / 44  # m from cell to cell
    pitch_y: Annotated[float, Field(ge=0, le=0.05, json_schema_extra=_METRES)] = 0.0  # 0: as pitch
    centre: tuple[Place, Place] = (0.0, 0.0)  # tip centre off the grid's centre (x, y)
    rotation: tuple[Angle, Angle] = (0.0, 0.0)  # sensor's axes against the finger's, about +z
    blur: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # m, the elastomer's standard deviation
    dead: tuple[Cells, Cells] = ((), ())  # cells [row, col] that are left out
    threshold: Annotated[int, Field(ge=0, le=255)] = 0  # smallest count sent; 0 stands for less
    pascal_per_count: Positive = 4.0  # Pa of one count
    full_count: Annotated[int, Field(ge=1, le=65535)] = 65535  # cells that read it are saturated
    rate: Rate = 100.0  # frames a second that are expected
    noise: Positive = 1520.0  # Pa a cell, standard deviation (0.5 % of 0.304 MPa)
    baseline_error: NonNegative = 0.0  # Pa, likewise of a shift of all cells since the tare
    slope_error: NonNegative = 0.0  # Pa, of the same from the tip's middle to its rim, x and y
    centre_error: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # m, of the tip's centre, x and y
    pitch_error: Annotated[float, Field(ge=0, le=0.1)] = 0.0  # relative
    rotation_error: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # rad, of the sensor about the tip
    skew_error: Annotated[float, Field(ge=0, le=0.01)] = 0.0  # m that a face goes during a scan
    # What neighbours share, of the pressure: crosstalk is below 3.3 % with a good read-out (arXiv
    # 2508.20959), linearity ± 3 % (FlexiForce's manual).
    smooth_error: Annotated[float, Field(ge=0, le=1)] = 0.035
    gain_error: Annotated[float, Field(gt=0, le=1)] = 0.25  # relative, likewise of all cells alike
    latency: Delay = 0.02  # s from the middle of a scan to the first byte on the wire
    response: Delay = 0.0  # s, first-order lag of the cells, made up for by the joints
    open_timeout: Seconds = 2.0  # s to wait for a first good frame
    sensor: tuple[str, str] = ("", "")  # identifies the sensors, as a serial number
    calibration: tuple[str, str] = ("", "")  # files of `softfinger calibrate`; replace what's above
    recording: tuple[str, str] = ("", "")  # backend = "replay": .npz, folder of .npy, ASCII export
    replay_again: bool = True  # backend = "replay": from the start at the end, else it ends


class EstimatorSettings(Section):
    """Estimation of d and θ from a frame.

    ``auto`` frees the gain of springs, and takes a solid tip's for known: its frames tell d by the
    force alone.
    """

    method: Literal["ml"] = "ml"  # maximum likelihood
    free_gain: Literal["auto", True, False] = "auto"  # estimate measured/modelled pressure too


class LoopSettings(Section):
    """The tick and its clock.

    ``real`` is this machine's time; ``hand`` a simulated hand's own, which waits while the machine
    is busy; ``virtual`` runs as fast as the machine can. The latter two need simulated backends;
    ``auto`` is ``hand`` with these and on the ports of `softfinger emulate`, else ``real``.
    """

    rate: Annotated[float, Field(ge=10, le=5000)] = 500.0  # Hz, ticks
    # auto: real; of a simulated hand one that stands still while the machine is late
    clock: Literal["auto", "hand", "real", "virtual"] = "auto"


class RealtimeSettings(Section):
    """Measures for a steady tick; the daemon reports what the system refuses and runs without it.

    All but the priority are harmless: a program at SCHED_FIFO keeps others off its processor.
    """

    priority: Annotated[int, Field(ge=0, le=80)] = 0  # of SCHED_FIFO; 0: the usual scheduling
    slice: Annotated[float, Field(ge=0, le=0.1)] = 1e-4  # s; short ones run sooner; 0: the system's
    cpus: tuple[Annotated[int, Field(ge=0, le=1023)], ...] = ()  # the loop's; none named: all
    lock_memory: bool = True  # nothing of the process is swapped out
    hold_latency: bool = True  # processors stay out of idle states that take long to leave
    timer_slack: Annotated[float, Field(ge=0, le=1e-3)] = 1e-9  # s; 0: the system's, 50 µs
    freeze_collector: bool = True  # a full collection would take tens of milliseconds
    spin: Annotated[float, Field(ge=0, le=1e-3)] = 5e-5  # s before a tick that are waited awake


class StreamSettings(Section):
    """The publisher. A topic goes out every n-th tick, with the n nearest to its rate."""

    address: str = STREAM_ADDRESS  # tcp or ipc
    state_rate: Rate = 100.0  # Hz
    tactile_rate: Rate = 100.0  # Hz, of each finger's frames
    tactile_unit: Literal["count", "Pa"] = "count"  # raw, or what the estimator makes of it
    queue: Annotated[int, Field(ge=1, le=100_000)] = 2000  # messages kept for a slow subscriber


class CommandSettings(Section):
    """The command server."""

    address: str = COMMAND_ADDRESS  # tcp or ipc
    lease: Seconds = 2.0  # s a commander keeps the hand after its last command
    on_silence: Literal["hold", "release", "stop"] = "hold"  # what the hand does then
    max_bytes: Annotated[int, Field(ge=64, le=1_000_000)] = 4096  # bytes of a command
    per_second: Annotated[float, Field(ge=1, le=10_000)] = 200.0  # a client; stop is always heard


class AccessSettings(Section):
    """Access to stream and commands. Addresses off this machine need keys."""

    keys: str = ""  # folder that `softfinger keys` made: both sockets take only its clients
    ipc_mode: Literal["0600", "0660", "0666"] = "0600"  # rights of an ipc address's file


class ControlSettings(Section):
    """Gains and rates of the control law; each default was chosen in simulation."""

    torque_constant: Factor = 1.78  # N·m per A at the joint (XM430-W350: 4.1 N·m at 2.3 A)
    torque_error: Annotated[float, Field(gt=0, le=1)] = 0.1  # relative, standard deviation
    approach_speed: Positive = 0.3  # rad/s
    approach_current: Positive = 0.15  # A, while closing: a tip that feels nothing presses no more
    move_speed: Positive = 1.0  # rad/s
    contact_force: Positive = 0.5  # N at which a finger counts as touching
    force_default: Positive = 5.0  # N, grasp without force=
    law: LawName = "energy"  # "upright" needs no angle
    force_time: Seconds = 0.1  # s in which the force goes from what is felt to what is wanted
    smooth_time: Seconds = 0.1  # s over which references are averaged: bounds their jerk
    force_gain: NonNegative = 1.0  # N a N of force error
    force_bandwidth: NonNegative = 1.0  # Hz of the force integral
    rotate_speed: Positive = 1.3  # rad/s of the object's angle
    rotate_bandwidth: NonNegative = 4.0  # Hz of the angle integral
    joint_stiffness: Positive = 45.0  # N·m/rad, on the antisymmetric motion
    dither_torque: NonNegative = 0.3  # N·m, antisymmetric, by which "upright" frees the joints
    dither_frequency: Annotated[float, Field(ge=3, le=50)] = 5.0  # Hz; slower, the grip would swing
    dither_time: Delay = 2.0  # s in which it fades
    joint_inertia: Factor = 0.010  # kg·m², finger and rotor: what is damped
    damping_ratio: NonNegative = 0.7  # of that inertia on the tips' and the joints' stiffness
    joint_friction: NonNegative = 0.05  # N·m of Coulomb friction, given where motion is wanted
    joint_load_friction: GearLoss = 0.0  # share of the gears' torque: MX-64 0.23, XL330 0.3
    friction_speed: Positive = 0.02  # rad/s wanted from which on all of it is given
    tip_friction: Positive = 0.6  # Coulomb, tip on object, that is counted on
    slip_margin: Fraction = 0.2  # share of that friction which is kept unused
    object_load: NonNegative = 0.0  # N along the tips' faces, the object's weight as a rule
    grip_raise_max: NonNegative = 10.0  # N that the grip may be raised to keep the margin …
    grip_raise_share: NonNegative = 1.0  # … and of the force asked for; the smaller one binds
    envelope: str = ""  # what the hand holds, by `softfinger envelope --keep`; "": the built-in's

    @property
    def driving(self) -> float:
        """Return a motor's torque over the tip's where the joint closes, (1 + μ)/(1 − μ).

        Gears bear both torques, and a share μ of each is friction. Where it opens, the inverse.
        """
        return (1.0 + self.joint_load_friction) / (1.0 - self.joint_load_friction)

    @property
    def load_held(self) -> float:
        """Return the fraction of a tip's moment that gears hold until the joint opens."""
        return 1.0 - self.driving**-2


class SafetySettings(Section):
    """Limits. The goal is bounded by them; crossing a hard one latches a fault."""

    current_max: Positive = 1.2  # A
    current_move: Positive = 0.4  # A, while nothing is grasped
    force_max: Positive = 30.0  # N
    d_max: Length = 0.012  # m
    theta_margin: Annotated[float, Field(ge=0, le=1)] = 0.05  # rad kept from the domain's limit
    velocity_max: Positive = 6.0  # rad/s
    frame_age_hold: Positive = 3.0  # frame periods: nothing is moved on
    frame_age_fault: Positive = 10.0  # frame periods: fault
    frame_age_action: Literal["torque off", "open"] = "torque off"  # open: first, then the fault
    goal_reach: Positive = 0.5  # rad off the present angle within which a goal may jump
    goal_speed: Positive = 3.0  # rad/s of a goal that is further off
    current_rate: Positive = 60.0  # A/s with which a goal current may rise
    current_fault: Positive = 1.8  # A measured for 0.1 s → fault
    stall_error: Positive = 0.1  # rad off its goal, with all the current it may take …
    stall_time: Seconds = 2.0  # … for so many s: a joint has stalled → fault
    temperature_max: Positive = 70.0  # °C of a servo → fault
    heat_warn: Positive = 60.0  # s before that: warned, and a grip eased to what lasts
    heat_action: Literal["hold", "release", "stop"] = "hold"  # where the load needs more
    voltage_min: NonNegative = 0.0  # V of a servo's supply → fault; 0: the model's own limit
    voltage_max: NonNegative = 0.0  # V, likewise
    residual_angle: Positive = 0.2  # rad between the object's angles by the two fingers → fault
    residual_width: Positive = 0.004  # m of the held object's width since the grip → fault
    residual_force: Positive = 0.5  # share by which the two tips' forces differ: warning
    saturated: Fraction = 0.05  # share of a sensor's cells that are full: warning
    frozen_after: Delay = 0.5  # s of identical frames while something touches → fault; 0: never
    overruns_fault: Annotated[int, Field(ge=1)] = 100  # ticks late in a row → fault


class ObjectSettings(Section):
    """Assumptions on the object."""

    width: Length = 0.040  # m between its faces
    taper: Annotated[float, Field(ge=-1.5, le=1.5)] = (
        0.0  # rad between its faces; above 0 it is wider at the palm
    )
    width_min: NonNegative = 0.002  # m; tips nearer to each other hold nothing: the hand opens


class SimulationSettings(Section):
    """The plant behind simulated backends and the emulator; these defaults are our own choice."""

    seed: Annotated[int, Field(ge=0)] = 1  # of noise and faults
    object_mass: Factor = 0.10  # kg
    object_shape: Annotated[str, _backend("shapes")] = "rectangle"  # seen from the side
    object_width: Length = 0.040  # m; of a wedge: at half its height
    object_height: Length = 0.060  # m, away from the palm
    object_radius: Length = 0.020  # m, of a disc
    object_taper: Annotated[float, Field(ge=-1.5, le=1.5)] = 0.17  # rad between a wedge's faces
    object_position: tuple[Place, Place] = (0.0, 0.080)  # m, in the hand's plane
    object_angle: Angle = 0.0  # rad, at the start
    gravity: tuple[Acceleration, Acceleration] = (
        0.0,
        0.0,
    )  # m/s²; the hand lies on a table
    table_friction: NonNegative = 0.3  # Coulomb, object on the table it lies on
    tip_friction: NonNegative = 0.6  # Coulomb, tip on object
    modulus_scale: Factor = 1.0  # the real tip over the settings' material
    tactile_noise: NonNegative = 1520.0  # Pa a cell
    tactile_gain: tuple[Factor, Factor] = (1.0, 1.0)  # each sensor reads so many times the pressure
    tactile_gain_spread: Fraction = 0.0  # standard deviation of the cells' sensitivities
    tactile_dead: Fraction = 0.0  # share of cells that read 0, beside those of tactile.dead
    tactile_blur: Annotated[float, Field(ge=0, le=0.1)] = 0.0  # m, standard deviation
    tactile_hysteresis: Fraction = 0.0  # reads up to so much more while a cell is unloaded
    tactile_creep: Fraction = 0.0  # rise of the reading under a lasting pressure
    tactile_creep_time: Positive = 10.0  # s in which it comes about
    tactile_response: Delay = 0.0  # s, first-order lag of the reading
    tactile_exponent: Factor = 1.0  # of the pressure that a cell's reading goes with
    tactile_fold: NonNegative = 0.0  # Pa above which a cell reads less again; 0: never
    tactile_crosstalk: Fraction = 0.0  # share of a line's mean that its cells read too much
    tactile_row_noise: NonNegative = 0.0  # Pa, what all cells of a row share
    tactile_drift: NonNegative = 0.0  # Pa, how far the cells' zeros wander
    tactile_gain_drift: Fraction = 0.0  # relative, likewise the gain of all, as by warmth
    tactile_drift_time: Positive = 60.0  # s in which they do
    tactile_delay: Delay = 0.020  # s from the middle of a scan to its arrival
    tactile_jitter: Delay = 0.0  # s that a frame may come later still
    tactile_dropped: Annotated[float, Field(ge=0, le=0.99)] = 0.0  # share of frames that never come
    palm: Place = 0.0  # m, the palm's place along y; the pivots are at 0
    palm_friction: NonNegative = 0.3  # Coulomb, object on the palm
    tip_loss: Delay = 0.002  # s, the tip's damping over its stiffness
    tip_law: Literal["springs", "bristles"] = "springs"  # along the face; springs lean with θ
    tip_shear_stiffness: Ratio = 1.0  # of its springs along the face over that across it
    tip_creep_time: NonNegative = 0.0  # s in which a stuck shear relaxes to 1/e; 0: it stays
    tip_micro_slip: bool = False  # the footprint's edge slips before all of it does
    # how much firmer a tip is at once than in the end, by each of three Prony terms; 0: elastic
    tip_relaxation: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    # s, of each: a human fingerpad's (Pawluk & Howe, 1999)
    tip_relaxation_times: tuple[Positive, Positive, Positive] = (0.004, 0.07, 1.4)
    joint_inertia: Factor = 0.010  # kg·m² at the joint: finger and reflected rotor
    joint_damping: NonNegative = 0.02  # N·m·s/rad
    joint_friction: NonNegative = 0.05  # N·m, Coulomb
    joint_stribeck: NonNegative = 0.0  # N·m of friction more at rest
    # share of the gears' torque that is friction, and so much more of it at rest
    joint_load_friction: tuple[Fraction, Fraction] = (0.0, 0.0)
    joint_stribeck_speed: Positive = 0.12  # rad/s over which what is more at rest falls to 1/e
    joint_presliding: Positive = 0.0005  # rad that gears give way elastically before they slip
    servo_heat: tuple[Factor, Factor, Factor] = (1.0, 1.0, 1.0)  # of heating, cooling, capacity
    ambient: Annotated[float, Field(ge=-40, le=80)] = 25.0  # °C around the servos
    compression_speed: NonNegative = 0.004  # m/s, presses the object on the tips; no servos only


class TaskSettings(Section):
    """Task that the daemon does by itself after start."""

    name: Literal["none", "demo"] = "none"  # what the hand does by itself
    force: Positive = 8.0  # N, the tips' mean
    angle: Angle = 0.14  # rad, to either side


class PluginSettings(Section):
    """A table for each plugin that has settings of its own, ``[plugins.NAME]``."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)

    @property
    def tables(self) -> dict[str, Any]:
        """The tables by the plugins' names, as they stand in the profile."""
        return self.model_extra or {}


class Settings(Section):
    """All sections. ``Settings()`` is the built-in simulated hand."""

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
        """Neither real servos nor real sensors take part."""
        servos, tactile = self.servos.backend, self.tactile.backend
        return not (backend("servos", servos).metal or backend("tactile", tactile).metal)
