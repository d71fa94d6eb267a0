"""Settings: TOML in, one validated `Settings` out, or one report with everything that is wrong.

Holds the sections with their defaults, bounds and units, and nothing that acts on them. The
defaults alone are the built-in simulated hand; ``config/sim.toml`` spells them out. Lengths are m,
angles rad, currents A, rates Hz; pairs are (left, right).
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Finger = Literal["left", "right"]
FINGER_NAMES = ("left", "right")
Index = Annotated[int, Field(ge=0, le=255)]
Cells = tuple[tuple[Index, Index], ...]
ServoMode = Literal["current-based position", "current", "position"]


class SettingsError(Exception):
    """The settings can't be used. The message lists every error: file, key, found, expected."""


class Section(BaseModel):
    """What all sections share: unknown keys are errors, values are not converted, nothing changes.

    A whole number is accepted where a float is asked for; a string never is.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Scene(Section):
    """What takes part. A backend set to ``none`` takes the servos or the sensors out."""

    fingers: Annotated[tuple[Finger, ...], Field(min_length=1, max_length=2)] = ("left", "right")
    object_model: bool = True  # estimate the object's angle and width from the two contacts


class Hand(Section):
    """Two rotational fingers in a plane: pivots at (∓pivot_separation/2, 0), q > 0 closes."""

    pivot_separation: Positive = 0.100
    finger_length: Positive = 0.080
    finger_offset: Finite = 0.0
    q_min: tuple[Finite, Finite] = (-0.5, -0.5)
    q_max: tuple[Finite, Finite] = (1.0, 1.0)
    open_angle: tuple[Finite, Finite] = (0.0, 0.0)  # where release goes


class Tip(Section):
    """The soft hemispherical fingertip."""

    radius: Positive = 0.020


class MaterialLaw(Section):
    """Stress-strain law of the tip: the paper's Table I, a constant modulus, or measured points."""

    law: Literal["table_i", "constant", "points"] = "table_i"
    modulus: Positive = 0.304e6  # Pa, for law = "constant"
    strain: tuple[Finite, ...] = ()  # for law = "points"
    stress: tuple[Finite, ...] = ()  # Pa, for law = "points"


class Table(Section):
    """The contact table: largest relative error of force, energy and their partials."""

    tolerance: Annotated[float, Field(ge=1e-13, le=1e-2)] = 1e-9


class ServoSettings(Section):
    """The joints."""

    backend: Literal["simulated", "dynamixel", "none"] = "simulated"
    port: str = "/dev/ttyUSB0"  # "{dir}" stands for the folder given by --dir
    baud: Annotated[int, Field(ge=9600, le=4_500_000)] = 2_000_000
    model: str = "XM430-W350"
    ids: tuple[Annotated[int, Field(ge=0, le=252)], Annotated[int, Field(ge=0, le=252)]] = (1, 2)
    direction: tuple[Literal[-1, 1], Literal[-1, 1]] = (1, -1)  # sign of counts when closing
    zero: tuple[int, int] = (2048, 2048)  # counts at q = 0
    gear_ratio: Positive = 1.0  # servo turns for one joint turn
    current_limit: tuple[Positive, Positive] = (6.0, 6.0)  # A; the servo's own limit binds too
    mode: ServoMode = "current-based position"  # or "current", or "position" (can't grasp)
    stiffness: Positive = 8.0  # A/rad of the daemon's position loop, in current mode alone
    damping: NonNegative = 0.4  # A·s/rad, likewise
    reply_timeout: Positive = 0.004  # s, a missing reply costs no more
    fault_after: Positive = 0.05  # s without a good exchange → fault
    watchdog: NonNegative = 0.1  # s, the servo's own bus watchdog; 0 leaves it off


class TactileSettings(Section):
    """The pressure grids under the tips."""

    backend: Literal["simulated", "flexitac", "glove", "cobs", "replay", "none"] = "simulated"
    port: tuple[str, str] = ("/dev/ttyUSB1", "/dev/ttyUSB2")
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 2_000_000
    rows: Annotated[int, Field(ge=4, le=256)] = 44
    cols: Annotated[int, Field(ge=4, le=256)] = 44
    pitch: Positive = 0.058 / 44
    pitch_y: NonNegative = 0.0  # from row to row; 0: as pitch
    centre: tuple[Finite, Finite] = (0.0, 0.0)  # tip centre off the grid's centre (x, y)
    rotation: tuple[Finite, Finite] = (0.0, 0.0)  # sensor's axes against the finger's, about +z
    dead: tuple[Cells, Cells] = ((), ())  # cells [row, col] that are left out
    threshold: Annotated[int, Field(ge=0, le=255)] = 0  # smallest count sent; 0 stands for less
    pascal_per_count: Positive = 4.0
    full_count: Annotated[int, Field(ge=1, le=65535)] = 65535  # cells that read it are saturated
    rate: Positive = 100.0  # frames a second that are expected
    noise: Positive = 1520.0  # Pa a cell, standard deviation (0.5 % of 0.304 MPa)
    latency: NonNegative = 0.005  # s from the middle of a scan to the first byte on the wire
    open_timeout: Positive = 2.0  # s to wait for a first good frame
    sensor: tuple[str, str] = ("", "")  # what tells the sensors from others, as a serial number
    calibration: tuple[str, str] = ("", "")  # files of `softfinger calibrate`; replace what's above
    recording: tuple[str, str] = ("", "")  # backend = "replay": .npz, folder of .npy, ASCII export
    replay_again: bool = True  # backend = "replay": from the start at the end, else it ends


class EstimatorSettings(Section):
    """How d and θ come from a frame."""

    method: Literal["moments", "ml"] = "ml"
    free_gain: bool = True  # estimate measured/modelled pressure too


class Loop(Section):
    """The tick. ``virtual`` runs as fast as the machine can and needs simulated backends."""

    rate: Annotated[float, Field(ge=10, le=5000)] = 500.0
    clock: Literal["real", "virtual"] = "real"


class Stream(Section):
    """The publisher. A topic's rate is exact: every n-th tick."""

    address: str = "tcp://127.0.0.1:9872"
    state_rate: Positive = 100.0
    tactile_rate: Positive = 25.0
    queue: Annotated[int, Field(ge=1, le=100_000)] = 200  # messages kept for a slow subscriber


class CommandSettings(Section):
    """The command server."""

    address: str = "tcp://127.0.0.1:9873"
    lease: Positive = 2.0  # s a commander keeps the hand after its last command
    max_bytes: Annotated[int, Field(ge=64, le=1_000_000)] = 4096


class Control(Section):
    """Gains and rates of the control law; each default was chosen in simulation."""

    torque_constant: Positive = 1.78  # N·m per A at the joint (XM430-W350: 4.1 N·m at 2.3 A)
    approach_speed: Positive = 0.3  # rad/s
    approach_current: Positive = 0.15  # A, while closing: a tip that feels nothing presses no more
    move_speed: Positive = 1.0  # rad/s
    contact_force: Positive = 0.5  # N at which a finger counts as touching
    force_default: Positive = 5.0  # N, grasp without force=
    law: Literal["energy", "two_phase", "position"] = "energy"  # "position" is for comparison
    force_time: Positive = 0.2  # s in which the force goes from what is felt to what is wanted
    smooth_time: Positive = 0.1  # s over which references are averaged: bounds their jerk
    force_gain: NonNegative = 1.0  # N a N of force error
    force_bandwidth: NonNegative = 1.0  # Hz of the force integral
    rotate_speed: Positive = 0.65  # rad/s of the object's angle
    rotate_bandwidth: NonNegative = 1.5  # Hz of the angle integral
    joint_stiffness: Positive = 45.0  # N·m/rad, on the antisymmetric motion
    joint_inertia: Positive = 0.010  # kg·m², finger and rotor: what is damped
    damping_ratio: NonNegative = 0.7  # of that inertia on the tips' and the joints' stiffness
    joint_friction: NonNegative = 0.05  # N·m of Coulomb friction, given where motion is wanted
    friction_speed: Positive = 0.02  # rad/s wanted from which on all of it is given
    tip_friction: Positive = 0.6  # Coulomb, tip on object, that is counted on
    slip_margin: Fraction = 0.2  # share of that friction which is kept unused
    object_load: NonNegative = 0.0  # N along the tips' faces, the object's weight as a rule
    grip_raise_max: NonNegative = 10.0  # N that the grip may be raised to keep the margin


class Safety(Section):
    """Limits. The goal is bounded by them; crossing a hard one latches a fault."""

    current_max: Positive = 1.2  # A
    current_move: Positive = 0.4  # A, while nothing is grasped
    force_max: Positive = 30.0  # N
    d_max: Positive = 0.012  # m
    theta_margin: NonNegative = 0.05  # rad kept from the domain's limit
    velocity_max: Positive = 6.0  # rad/s
    frame_age_hold: Positive = 3.0  # frame periods: goals freeze
    frame_age_fault: Positive = 10.0  # frame periods: fault
    overruns_fault: Annotated[int, Field(ge=1)] = 100  # ticks late in a row → fault


class ObjectSettings(Section):
    """What the daemon assumes of the object."""

    width: Positive = 0.040


class Simulation(Section):
    """The plant behind simulated backends and the emulator; these defaults are our own choice."""

    seed: Annotated[int, Field(ge=0)] = 1
    object_mass: Positive = 0.10  # kg
    object_width: Positive = 0.040
    object_height: Positive = 0.060
    object_position: tuple[Finite, Finite] = (0.0, 0.080)  # m, in the hand's plane
    object_angle: Finite = 0.0
    gravity: tuple[Finite, Finite] = (0.0, 0.0)  # m/s² in the plane: the hand lies on a table
    table_friction: NonNegative = 0.3  # Coulomb, object on the table it lies on
    tip_friction: NonNegative = 0.6  # Coulomb, tip on object
    modulus_scale: Positive = 1.0  # the real tip over the settings' material
    tactile_noise: NonNegative = 1520.0  # Pa a cell
    tactile_delay: NonNegative = 0.010  # s from the middle of a scan to its arrival
    palm: Finite = 0.0  # m, the palm's place along y; the pivots are at 0
    tip_loss: NonNegative = 0.002  # s, the tip's damping over its stiffness
    joint_inertia: Positive = 0.010  # kg·m² at the joint: finger and reflected rotor
    joint_damping: NonNegative = 0.02  # N·m·s/rad
    joint_friction: NonNegative = 0.05  # N·m, Coulomb
    compression_speed: NonNegative = 0.004  # m/s, presses the object on the tips; no servos only


class Task(Section):
    """What the daemon does by itself after start."""

    name: Literal["none", "demo"] = "none"
    force: Positive = 8.0
    angle: Finite = 0.14


class Settings(Section):
    """All sections. ``Settings()`` is the built-in simulated hand."""

    scene: Scene = Scene()
    hand: Hand = Hand()
    tip: Tip = Tip()
    material: MaterialLaw = MaterialLaw()
    table: Table = Table()
    servos: ServoSettings = ServoSettings()
    tactile: TactileSettings = TactileSettings()
    estimator: EstimatorSettings = EstimatorSettings()
    loop: Loop = Loop()
    stream: Stream = Stream()
    commands: CommandSettings = CommandSettings()
    control: Control = Control()
    safety: Safety = Safety()
    object: ObjectSettings = ObjectSettings()
    simulation: Simulation = Simulation()
    task: Task = Task()


def load(path: Path | None = None, directory: Path | None = None) -> Settings:
    """Read and check a profile; None gives the built-in simulated hand.

    ``directory`` replaces ``{dir}`` in the ports. Raises SettingsError with one line for every
    unknown key, wrong type and broken bound.
    """
    name = str(path) if path else "built-in settings"
    try:
        text = path.read_text(encoding="utf-8") if path else ""
        raw = tomllib.loads(text)
    except OSError as error:
        raise SettingsError(f"{name}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise SettingsError(f"{name}: not UTF-8 text: {error.reason}") from None
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{name}: not TOML: {error}") from None
    data = _tuples(raw)
    problems: list[str] = []
    try:
        settings = Settings.model_validate(data)
    except ValidationError as error:
        problems = [_line(name, details) for details in error.errors()]
    else:
        problems = [f"{name}: {problem}" for problem in _contradictions(settings, directory)]
    if problems:
        raise SettingsError("\n".join(problems))
    return settings if directory is None else _with_directory(settings, directory)


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    return value


def _line(name: str, details: ErrorDetails) -> str:
    location = [str(part) for part in details["loc"]]
    key = ".".join(location)
    if details["type"] == "extra_forbidden":
        known = _known_keys(location[:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.0)
        return f"{name}: {key}: found an unknown key, expected a known one; nearest: {near[0]}"
    expected = details["msg"].removeprefix("Input should ").removeprefix("be ")
    expected = expected.removeprefix("Tuple should have ").replace(" after validation", "")
    expected = (
        expected.replace("a valid tuple", "an array")
        .replace("a valid integer", "a whole number")
        .replace("a valid ", "a ")
    )
    return f"{name}: {key}: found {_shown(details['input'])}, expected {expected}"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _known_keys(location: list[str]) -> list[str]:
    model: type[BaseModel] = Settings
    for part in location:
        inner = model.model_fields[part].annotation
        assert isinstance(inner, type)
        assert issubclass(inner, BaseModel)
        model = inner
    return list(model.model_fields)


def _contradictions(settings: Settings, directory: Path | None) -> list[str]:
    """What each key allows but all of them together don't."""
    found = []
    scene, hand, material = settings.scene, settings.hand, settings.material
    if len(set(scene.fingers)) != len(scene.fingers):
        found.append(f"scene.fingers: found {_shown(scene.fingers)}, expected each finger once")
    if settings.servos.backend == "none" and settings.tactile.backend == "none":
        found.append("servos.backend, tactile.backend: found none and none, expected at least one")
    for index, finger in enumerate(FINGER_NAMES):
        low, open_, high = hand.q_min[index], hand.open_angle[index], hand.q_max[index]
        if not low < high:
            found.append(f"hand.q_max: found {high:g} for {finger}, expected above q_min {low:g}")
        elif not low <= open_ <= high:
            found.append(
                f"hand.open_angle: found {open_:g} for {finger}, expected {low:g} to {high:g}"
            )
    if settings.servos.ids[0] == settings.servos.ids[1] and len(scene.fingers) == 2:
        found.append(f"servos.ids: found {_shown(settings.servos.ids)}, expected two different ids")
    if material.law == "points" and len(material.strain) != len(material.stress):
        found.append(
            f"material.stress: found {len(material.stress)} numbers, "
            f"expected {len(material.strain)} as in material.strain"
        )
    tactile = settings.tactile
    for index, cells in enumerate(tactile.dead):
        found += [
            f"tactile.dead: found {_shown(cell)} for {FINGER_NAMES[index]}, "
            f"expected a cell of {tactile.rows} × {tactile.cols}"
            for cell in cells
            if cell[0] >= tactile.rows or cell[1] >= tactile.cols
        ]
    if tactile.backend == "replay":
        found += [
            f'tactile.recording: found "" for {name}, expected a recording'
            for name in scene.fingers
            if not tactile.recording[FINGER_NAMES.index(name)]
        ]
    simulated = {settings.servos.backend, tactile.backend} <= {"simulated", "replay", "none"}
    if settings.loop.clock == "virtual" and not simulated:
        found.append('loop.clock: found "virtual", expected "real" with hardware backends')
    ports = []
    if settings.servos.backend == "dynamixel":
        ports.append(("servos.port", settings.servos.port))
    if tactile.backend not in ("simulated", "replay", "none"):
        ports += [("tactile.port", port) for port in settings.tactile.port]
    if directory is None:
        found += [
            f"{key}: found {_shown(port)}, expected --dir to say which folder {{dir}} is"
            for key, port in ports
            if "{dir}" in port
        ]
    return found


def _with_directory(settings: Settings, directory: Path) -> Settings:
    def filled(port: str) -> str:
        return port.replace("{dir}", str(directory))

    left, right = settings.tactile.port
    servos = settings.servos.model_copy(update={"port": filled(settings.servos.port)})
    tactile = settings.tactile.model_copy(update={"port": (filled(left), filled(right))})
    return settings.model_copy(update={"servos": servos, "tactile": tactile})
