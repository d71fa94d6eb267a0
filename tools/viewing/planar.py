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

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.plant_state import NO_OBJECT
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.hand.geometry import HandGeometry
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.terminal import feed
from softfinger.tools.terminal.feed import number
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


def between(first: Colour, second: Colour, share: float) -> Colour:
    """A mixture of two colours with ``share`` of the second."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return red, green, blue


FloatArray = NDArray[np.float64]

_ARROW = 1.6e-3  # m of a force's arrow a newton
_ARROW_LONGEST = 0.045  # m
SPRINGS = 17  # drawn in a tip, of the continuum that the model has
_ANGLES = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)


@dataclass(frozen=True)
class Touch:
    """One tip's contact: d [m], θ [rad], F [N]."""

    d: float
    theta: float
    force: float


def touch(state: dict[str, Any] | None, name: str) -> Touch | None:
    """One tip's contact in a ``hand/state``, None where there is none."""
    if feed.field(state, name, "contact") is not True:
        return None
    d, theta, force = (number(state, name, key) for key in ("d", "theta", "force"))
    if not (math.isfinite(d) and math.isfinite(theta) and d > 0.0):
        return None
    return Touch(d, theta, force if math.isfinite(force) else 0.0)


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
    hand: HandGeometry, finger: int, q: float, contact: Touch | None = None
) -> FingerLines:
    """The lines of finger 0 (left) or 1 (right) at joint angle ``q`` [rad]."""
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
    if contact is not None and 0.0 < contact.d < a and abs(contact.theta) < 0.5 * math.pi:
        sine, cosine, h = math.sin(contact.theta), math.cos(contact.theta), a - contact.d
        skin = np.clip((h - rim * sine) / cosine, 0.0, skin)
        length = np.clip((h - inner * sine) / cosine, 0.0, free)
        rho = math.sqrt(2.0 * a * contact.d - contact.d**2)
        middle, inwards = h * np.array([sine, cosine]), np.array([sine, cosine])
        ends = middle + np.outer((-rho, rho), (cosine, -sine))
        face = place(ends[:, 0], ends[:, 1])
        lines = np.array([middle, middle - 0.6 * a * inwards])
        normal = place(lines[:, 0], lines[:, 1])
        x = (a - contact.d / 3.0) * sine  # the centroid of pressure
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


def true_outline(settings: Settings, truth: dict[str, Any]) -> FloatArray | None:
    """The simulated object's outline [n, 2] m, closed, by a ``hand/truth``; None without one."""
    try:
        shape = shape_of(settings)
    except ValueError:  # a stranger's wedge whose faces meet
        return None
    if shape.kind == NO_OBJECT:
        return None
    x, y, angle = (number(truth, "true_object", key) for key in ("x", "y", "angle"))
    own = np.vstack((shape.corners, shape.corners[:1]))
    if shape.roundness > 0.0:
        own = shape.roundness * np.column_stack((np.cos(_TURN), np.sin(_TURN)))
    cosine, sine = math.cos(angle), math.sin(angle)
    turned: FloatArray = own @ np.array([(cosine, sine), (-sine, cosine)]) + (x, y)
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


class HandScene:
    """The moving hand: its parts by name, always all of them."""

    def __init__(self, hand: ShownHand) -> None:
        self._hand = hand

    def parts(self, state: dict[str, Any]) -> dict[str, HandPart]:
        """All but the simulated object, by a ``hand/state``."""
        hand = self._hand
        half = hand.geometry.half_separation + 0.012
        parts = {"palm": HandPart([Strip(np.array([(-half, 0.0), (half, 0.0)]), SPRING, 2.4)])}
        contacts = [touch(state, name) for name in hand.fingers]
        for name, contact in zip(hand.fingers, contacts, strict=True):
            q = number(state, name, "q")
            index, angle = FINGERS.index(name), q if math.isfinite(q) else 0.0
            parts[name] = _part(finger_lines(hand.geometry, index, angle, contact), name, contact)
        parts["object"] = self._held(state, *contacts)
        return parts

    def _held(self, state: dict[str, Any], *contacts: Touch | None) -> HandPart:
        """The object between both tips; nothing where both don't hold it."""
        held = [contact for contact in contacts if contact is not None]
        if len(held) < 2 or feed.field(state, "object", "valid") is not True:
            return HandPart([])
        outline = held_outline(
            self._hand.geometry,
            (number(state, "left", "q"), number(state, "right", "q")),
            np.array([contact.d for contact in held]),
            np.array([contact.theta for contact in held]),
            number(state, "object", "width"),
            self._hand.settings.simulation.object_height,
        )
        return HandPart([Strip(outline, OBJECT, 1.4)] if np.isfinite(outline).all() else [])

    def simulated(self, truth: dict[str, Any] | None) -> HandPart:
        """The simulated object's true pose, by a ``hand/truth`` if there is any."""
        outline = None if truth is None else true_outline(self._hand.settings, truth)
        return HandPart([] if outline is None else [Strip(outline, GOAL, 0.6)])


def _part(finger: FingerLines, name: str, contact: Touch | None) -> HandPart:
    """One finger with its tip, and where it touches the face and the force's arrow."""
    colour = COLOURS[name]
    lines = ((finger.link, 5.2), (finger.base, 2.4), (finger.skin, 1.0))
    strips = [Strip(line, colour, width) for line, width in lines]
    for spring, strain in zip(finger.springs, finger.strain, strict=True):
        share = min(4.0 * float(strain), 1.0)
        shade = between(SPRING, LEVELS["error"], share)
        strips.append(Strip(spring, shade, 0.5 + 0.7 * share))
    if contact is None or finger.face is None or finger.normal is None or finger.push is None:
        return HandPart(strips)
    strips += [Strip(finger.face, OBJECT, 2.0), Strip(finger.normal, GOAL, 0.7)]
    at, direction = finger.push
    way = min(_ARROW * contact.force, _ARROW_LONGEST) * direction
    return HandPart(strips, [Push(at, way, f"{contact.force:.1f} N", colour)])


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


def grid_of(frame: dict[str, Any]) -> SensorGrid | None:
    """The grid of a ``hand/tactile``, None where its fields make none."""
    rows, cols = frame.get("rows"), frame.get("cols")
    pitch = number(frame, "pitch")
    if type(rows) is not int or type(cols) is not int:
        return None
    more = [number(frame, key) for key in ("pitch_y", "centre_x", "centre_y", "rotation")]
    pitch_y, x, y, rotation = (value if math.isfinite(value) else 0.0 for value in more)
    try:
        return SensorGrid(rows, cols, (pitch, pitch_y or pitch), (x, y), rotation)
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
