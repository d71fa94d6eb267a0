"""Lines to draw: fingers, soft tips with their springs, object, forces; a contact's footprint.

In the hand's plane [m]: x from the left pivot to the right one, y away from the palm. A tip's own
axes are x along its base and z out of it; in them the object's face is
``x sin θ + z cos θ = a − d``. `hand.geometry` has the tips' places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.plant_state import NO_OBJECT
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import (
    FingerState,
    HandState,
    TactileFrame,
    TrueObject,
    TrueState,
)
from softfinger.kinematics.hand.geometry import HandGeometry
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.viewing.known import ShownHand

# The left finger is blue, the right one orange, goals are grey: distinguishable for colour-blind
# people, on light and on dark ground.
Colour = tuple[int, int, int]

COLOURS = {"left": (51, 136, 221), "right": (230, 126, 0)}
GOAL = (140, 140, 140)
OBJECT = (0, 158, 115)
LATE = (204, 96, 150)
SPRING = (150, 150, 150)
LEVELS = {"info": (120, 120, 120), "warning": (214, 140, 0), "error": (214, 54, 40)}


FloatArray = NDArray[np.float64]

_ARROW = 1.6e-3  # m of a force's arrow a newton
_ARROW_LONGEST = 0.045  # m
SPRINGS = 17  # drawn in a tip, of the continuum that the model has
_ANGLES = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)


def touches(finger: FingerState) -> bool:
    """Return whether a tip has a contact that can be drawn."""
    return finger.contact and 0.0 < finger.d < math.inf and math.isfinite(finger.theta)


@dataclass(frozen=True)
class FingerLines:
    """One finger's lines, each [n, 2] m. ``springs`` [SPRINGS, 2, 2] go from base to skin."""

    link: FloatArray  # pivot, end of the link, centre of the tip's base
    base: FloatArray
    skin: FloatArray
    springs: FloatArray
    strain: FloatArray  # [SPRINGS]
    face: FloatArray | None  # where the object's face touches, end to end
    normal: FloatArray | None  # [2, 2], from the face's middle out of the object, a fixed length
    push: FloatArray | None  # [2, 2], where the tip pushes on the object and in which direction (1)


def finger_lines(
    hand: HandGeometry, finger: int, q: float, d: float = 0.0, theta: float = 0.0
) -> FingerLines:
    """The lines of finger 0 (left) or 1 (right) at joint angle ``q`` [rad]; ``d`` [m] 0: free."""
    a = hand.tip_radius
    centre = hand.tips((q, q))[finger]
    along, out = tip_axes(finger, q)
    side = 1.0 if finger == 0 else -1.0
    pivot = np.array([-side * hand.half_separation, 0.0])
    end = pivot + hand.finger_length * np.array([side * math.sin(q), math.cos(q)])

    def place(x: FloatArray, z: FloatArray) -> FloatArray:
        placed: FloatArray = centre + x[:, None] * along + z[:, None] * out
        return placed

    rim = a * np.sin(_ANGLES)
    inner = a * np.linspace(-0.94, 0.94, SPRINGS)
    free = np.sqrt(a * a - inner * inner)
    skin, length = a * np.cos(_ANGLES), free
    face = normal = push = None
    if 0.0 < d < a and abs(theta) < 0.5 * math.pi:
        sine, cosine, h = math.sin(theta), math.cos(theta), a - d
        skin = np.clip((h - rim * sine) / cosine, 0.0, skin)
        length = np.clip((h - inner * sine) / cosine, 0.0, free)
        rho = math.sqrt(2.0 * a * d - d**2)
        middle, inwards = h * np.array([sine, cosine]), np.array([sine, cosine])
        ends = middle + np.outer((-rho, rho), (cosine, -sine))
        face = place(ends[:, 0], ends[:, 1])
        lines = np.array([middle, middle - 0.6 * a * inwards])
        normal = place(lines[:, 0], lines[:, 1])
        x = (a - d / 3.0) * sine  # the centroid of pressure
        at = place(np.array([x]), np.array([(h - x * sine) / cosine]))[0]
        push = np.array([at, out])
    springs = np.stack((place(inner, np.zeros(SPRINGS)), place(inner, length)), axis=1)
    return FingerLines(
        np.array([pivot, end, centre]),
        place(np.array([-a, a]), np.zeros(2)),
        place(rim, skin),
        springs,
        1.0 - length / free,
        face,
        normal,
        push,
    )


def tip_axes(finger: int, q: float) -> tuple[FloatArray, FloatArray]:
    """A tip's own x and z in the hand's plane, unit vectors [2]: n·x = sin θ, n·z = cos θ."""
    sine, cosine = math.sin(q), math.cos(q)
    if finger == 0:
        return np.array([sine, cosine]), np.array([cosine, -sine])
    return np.array([sine, -cosine]), np.array([-cosine, -sine])


def held_outline(
    hand: HandGeometry,
    q: tuple[float, float],
    d: FloatArray,
    theta: FloatArray,
    width: float,
    height: float,
) -> FloatArray:
    """Return the held object's outline [5, 2] m, closed, from joints and contacts, left first.

    Across its faces it follows from the contacts; along them it is taken to be centred on them.
    """
    a = hand.tip_radius
    angle = 0.5 * (theta[0] + theta[1] - q[0] + q[1])
    n = np.array([math.cos(angle), math.sin(angle)])
    t = np.array([-n[1], n[0]])
    tips = hand.tips(q)
    across = 0.5 * (tips[0] @ n + a - d[0] + tips[1] @ n - a + d[1])
    centre = across * n + (tips @ t).mean() * t
    corners = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1), (-1, -1)])
    outline: FloatArray = (
        centre + 0.5 * width * corners[:, :1] * n + 0.5 * height * corners[:, 1:] * t
    )
    return outline


def true_outline(settings: Settings, pose: TrueObject) -> FloatArray | None:
    """The simulated object's outline [n, 2] m, closed, at its true ``pose``; None without one."""
    try:
        shape = shape_of(settings)
    except ValueError:  # a stranger's wedge whose faces meet
        return None
    if shape.kind == NO_OBJECT:
        return None
    own = np.vstack((shape.corners, shape.corners[:1]))
    if shape.roundness > 0.0:
        own = shape.roundness * np.column_stack((np.cos(_TURN), np.sin(_TURN)))
    # NumPy's, of which an infinite angle is NaN.
    cosine, sine = np.cos(pose.angle), np.sin(pose.angle)
    turned: FloatArray = own @ np.array([(cosine, sine), (-sine, cosine)]) + (pose.x, pose.y)
    return turned if np.isfinite(turned).all() else None


@dataclass(frozen=True)
class Strip:
    """A line to draw: points [n, 2] m, colour, and ``width`` [mm]."""

    points: FloatArray
    colour: Colour
    width: float


@dataclass(frozen=True)
class Push:
    """A force's arrow: from where, its way [2] m, and what stands at its end."""

    at: FloatArray
    way: FloatArray
    text: str
    colour: Colour


@dataclass(frozen=True)
class HandPart:
    """A part of the picture, empty where it isn't there now."""

    strips: list[Strip]
    pushes: list[Push] = field(default_factory=list)


def hand_parts(
    hand: ShownHand, state: HandState, truth: dict[str, Any] | None = None
) -> dict[str, HandPart]:
    """Return the moving hand's parts by name, always all of them; ``truth``: a ``hand/truth``."""
    half = hand.geometry.half_separation + 0.012
    parts = {"palm": HandPart([Strip(np.array([(-half, 0.0), (half, 0.0)]), SPRING, 2.4)])}
    for name in hand.fingers:
        parts[name] = _finger_part(hand.geometry, name, state.finger(name))
    parts["object"] = _held(hand, state)
    pose = read(TrueState, truth).true_object
    outline = None if truth is None else true_outline(hand.settings, pose)
    parts["simulated"] = HandPart([] if outline is None else [Strip(outline, GOAL, 0.6)])
    return parts


def _held(hand: ShownHand, state: HandState) -> HandPart:
    """The object between both tips; nothing where both don't hold it."""
    tips = [state.finger(name) for name in hand.fingers]
    if len(tips) < 2 or not state.object.valid or not all(map(touches, tips)):
        return HandPart([])
    q = state.left.q, state.right.q
    d, theta = (np.array([getattr(tip, key) for tip in tips]) for key in ("d", "theta"))
    height = hand.settings.simulation.object_height
    outline = held_outline(hand.geometry, q, d, theta, state.object.width, height)
    return HandPart([Strip(outline, OBJECT, 1.4)] if np.isfinite(outline).all() else [])


def _finger_part(hand: HandGeometry, name: str, state: FingerState) -> HandPart:
    """One finger with its tip, and where it touches the face and the force's arrow."""
    contact = (state.d, state.theta) if touches(state) else ()
    q, colour = state.q if math.isfinite(state.q) else 0.0, COLOURS[name]
    finger = finger_lines(hand, FINGERS.index(name), q, *contact)
    lines = ((finger.link, 5.2), (finger.base, 2.4), (finger.skin, 1.0))
    strips = [Strip(line, colour, width) for line, width in lines]
    for spring, strain in zip(finger.springs, finger.strain, strict=True):
        fraction = min(4.0 * float(strain), 1.0)
        mixed = (1.0 - fraction) * np.array(SPRING) + fraction * np.array(LEVELS["error"])
        strips.append(Strip(spring, tuple(np.rint(mixed).tolist()), 0.5 + 0.7 * fraction))
    if finger.face is None or finger.normal is None or finger.push is None:
        return HandPart(strips)
    strips += [Strip(finger.face, OBJECT, 2.0), Strip(finger.normal, GOAL, 0.7)]
    at, direction = finger.push
    force = state.force if math.isfinite(state.force) else 0.0
    way = min(_ARROW * force, _ARROW_LONGEST) * direction
    return HandPart(strips, [Push(at, way, f"{force:.1f} N", colour)])


# A picture's coordinates are cells: x along the columns, y along the rows, from the corner of the
# first cell. The footprint of displacement d and outward normal n, in the sensor's axes, is an
# ellipse with centre h·(n_x, n_y), h = a − d, semi-axes ρ n_z along the tilt and ρ across it,
# ρ² = 2ad − d²; the centroid of pressure stands at (a − d/3)·(n_x, n_y), free of the material only
# where the modulus is constant (of a measured law it is a close estimate).
_TURN = np.linspace(0.0, 2.0 * np.pi, 61)


@dataclass(frozen=True)
class Footprint:
    """A contact on the picture of a frame. ``outline`` [n, 2] is closed, ``centroid`` is [2]."""

    outline: FloatArray
    centroid: FloatArray


def grid_of(frame: TactileFrame) -> SensorGrid | None:
    """The grid of a ``hand/tactile``, None where its fields make none."""
    more = (frame.pitch_y, frame.centre_x, frame.centre_y, frame.rotation)
    pitch_y, x, y, rotation = (value if math.isfinite(value) else 0.0 for value in more)
    pitches = frame.pitch, pitch_y or frame.pitch
    try:
        return SensorGrid(frame.rows, frame.cols, pitches, (x, y), rotation)
    except ValueError:
        return None


def footprint(
    grid: SensorGrid, radius: float, d: float, tilt_x: float, tilt_y: float
) -> Footprint | None:
    """The footprint of a contact on ``grid``'s picture; None for numbers of no contact.

    ``radius`` and ``d`` [m], tilts [rad] in the finger's axes.
    """
    if not 0.0 < d < radius or not math.isfinite(tilt_x) or not math.isfinite(tilt_y):
        return None
    n_x, n_y = grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
    sine = math.hypot(n_x, n_y)
    if sine >= 1.0:
        return None
    along_x, along_y = (n_x / sine, n_y / sine) if sine > 0.0 else (1.0, 0.0)
    across = math.sqrt(2.0 * radius * d - d * d)
    along = across * math.sqrt(1.0 - sine * sine)
    u, v = along * np.cos(_TURN), across * np.sin(_TURN)
    depth = radius - d
    x = depth * n_x + u * along_x - v * along_y
    y = depth * n_y + u * along_y + v * along_x
    arm = radius - d / 3.0
    centroid = on_picture(grid, np.array([[arm * n_x, arm * n_y]]))[0]
    return Footprint(on_picture(grid, np.column_stack((x, y))), centroid)


def tip_circle(grid: SensorGrid, radius: float) -> FloatArray:
    """The tip's rim on the picture, [n, 2]."""
    return on_picture(grid, radius * np.column_stack((np.cos(_TURN), np.sin(_TURN))))


def on_picture(grid: SensorGrid, points: FloatArray) -> FloatArray:
    """Points [n, 2] m in the sensor's axes, from the tip's centre → cells on the picture."""
    middle = np.array([0.5 * grid.cols, 0.5 * grid.rows])
    cells: FloatArray = (points + np.array(grid.centre)) / np.array(grid.pitches) + middle
    return cells
