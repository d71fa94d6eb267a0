"""Compute the lines of a drawing: fingers, tips, object, forces and contact footprints.

Coordinates are in the hand's plane [m]. x points from the left to the right pivot, and y points
away from the palm. In a tip's own axes, x is along the tip's base and z is normal to the base. In
these axes, the equation of the object's face is ``x sin θ + z cos θ = a − d``. `hand.geometry`
computes the tip positions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.daemon.client.stream import read
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.plant_state import NO_OBJECT
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.simulation.physics.simulated_hand import geometry_of
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import FingerState, HandState, TactileFrame, TrueState
from softfinger.kinematics.hand.geometry import HandGeometry
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

FloatArray = NDArray[np.float64]
GOAL, OBJECT = "goal", "object"  # colour names in addition to the finger names

# Colour-blind users can distinguish these colours on a dark background. The page defines separate
# colours for each theme.
COLOURS = {
    "left": (51, 136, 221),
    "right": (230, 126, 0),
    GOAL: (140, 140, 140),
    OBJECT: (0, 158, 115),
}

_ARROW_SCALE = 1.6e-3  # length of a force arrow per newton [m/N]
_ARROW_MAX = 0.045  # maximum length of a force arrow [m]
_HALF_TURN = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)
_TURN = np.linspace(0.0, 2.0 * np.pi, 61)
_UNIT_CIRCLE = np.column_stack((np.cos(_TURN), np.sin(_TURN)))


class DrawnPart(NamedTuple):
    """Lines and labels for one part of a picture; both lists are empty if the part is absent."""

    lines: list[tuple[str, float, FloatArray]]  # colour name, width [m], points [n, 2] [m]
    texts: list[tuple[str, FloatArray, str]]  # colour name, position [2] and text of each label


def touches(finger: FingerState) -> bool:
    """Return True if the tip has a contact that can be drawn."""
    return finger.contact and 0.0 < finger.d < math.inf and math.isfinite(finger.theta)


def finger_part(hand: HandGeometry, finger: int, state: FingerState) -> DrawnPart:
    """Draw finger 0 (left) or 1 (right): link, base and skin of the tip.

    A contact adds the line along which the tip touches the object's face, and the force arrow.
    """
    a, side, name = hand.tip_radius, 1.0 if finger == 0 else -1.0, FINGERS[finger]
    q, d = state.q if math.isfinite(state.q) else 0.0, state.d
    sine, cosine = math.sin(q), math.cos(q)
    along, out = np.array([sine, side * cosine]), np.array([side * cosine, -sine])
    centre = hand.tips((q, q))[finger]
    pivot = np.array([-side * hand.half_separation, 0.0])

    def place(x: ArrayLike, z: ArrayLike) -> FloatArray:
        placed: FloatArray = centre + np.multiply.outer(x, along) + np.multiply.outer(z, out)
        return placed

    rim, skin = a * np.sin(_HALF_TURN), a * np.cos(_HALF_TURN)
    contact: list[tuple[str, float, FloatArray]] = []
    texts = []
    if touches(state) and d < a and abs(state.theta) < 0.5 * math.pi:
        n_x, n_z, h = math.sin(state.theta), math.cos(state.theta), a - d
        skin = np.clip((h - rim * n_x) / n_z, 0.0, skin)
        ends = math.sqrt(2.0 * a * d - d * d) * np.array([-1.0, 1.0])
        face = place(h * n_x + ends * n_z, h * n_z - ends * n_x)
        x = (a - d / 3.0) * n_x  # pressure centroid
        force = state.force if math.isfinite(state.force) else 0.0
        at, way = place(x, (h - x * n_x) / n_z), min(_ARROW_SCALE * force, _ARROW_MAX) * out
        end, back, aside = at + way, -0.2 * way, 0.12 * np.array([way[1], -way[0]])
        arrow = np.array([at, end, end + back + aside, end, end + back - aside])
        contact = [(OBJECT, 2e-3, face), (name, 1.8e-3, arrow)]
        texts = [(name, centre + np.array([-0.028 * side, 0.012]), f"{force:.1f} N")]
    link = np.array([pivot, pivot + hand.finger_length * np.array([side * sine, cosine]), centre])
    base = place([-a, a], [0.0, 0.0])
    tip = [(name, 5.2e-3, link), (name, 2.4e-3, base), (name, 1e-3, place(rim, skin))]
    return DrawnPart([*tip, *contact], texts)


def held_outline(hand: HandGeometry, state: HandState, height: float) -> list[FloatArray]:
    """Return a list with the held object's closed outline ([5, 2] in m), or an empty list.

    The outline starts at the left finger. The joint angles and contacts determine the object's
    position perpendicular to its faces. Along the faces, the object is assumed to be centred on the
    contacts.
    """
    fingers = state.left, state.right
    if not state.object.valid or not all(map(touches, fingers)):
        return []
    q, d, theta = ([getattr(each, key) for each in fingers] for key in ("q", "d", "theta"))
    angle = 0.5 * (theta[0] + theta[1] - q[0] + q[1])
    if not math.isfinite(angle):
        return []
    a, tips = hand.tip_radius, hand.tips((q[0], q[1]))
    n = np.array([math.cos(angle), math.sin(angle)])
    t = np.array([-n[1], n[0]])
    across = 0.5 * (tips[0] @ n + a - d[0] + tips[1] @ n - a + d[1])
    size = state.object.width, height
    corners = 0.5 * np.array([(-1, -1), (-1, 1), (1, 1), (1, -1), (-1, -1)]) * size
    outline = across * n + (tips @ t).mean() * t + corners @ np.array([n, t])
    return [outline] if np.isfinite(outline).all() else []


def _true_outline(settings: Settings, truth: dict[str, Any] | None) -> list[FloatArray]:
    """Return a list that contains the object's true outline ([n, 2] in m), or an empty list."""
    pose = read(TrueState, truth).true_object
    try:
        shape = shape_of(settings)
    except ValueError:  # The settings describe a wedge whose faces intersect.
        return []
    own = np.vstack((shape.corners, shape.corners[:1]))
    if shape.roundness > 0.0:
        own = shape.roundness * _UNIT_CIRCLE
    # For an infinite angle, NumPy returns NaN, whereas `math` raises an exception.
    cosine, sine = np.cos(pose.angle), np.sin(pose.angle)
    turned = own @ np.array([(cosine, sine), (-sine, cosine)]) + (pose.x, pose.y)
    return [turned] if shape.kind != NO_OBJECT and np.isfinite(turned).all() else []


def hand_parts(
    settings: Settings, state: HandState, truth: dict[str, Any] | None = None
) -> dict[str, DrawnPart]:
    """Return all moving parts by name; ``truth`` is a ``hand/truth`` message."""
    hand = geometry_of(settings)
    half = hand.half_separation + 0.012
    parts = {"palm": DrawnPart([(GOAL, 2.4e-3, np.array([(-half, 0.0), (half, 0.0)]))], [])}
    for k in settings.scene.indices:
        parts[FINGERS[k]] = finger_part(hand, k, state.finger(FINGERS[k]))
    held = held_outline(hand, state, settings.simulation.object_height)
    parts["object"] = DrawnPart([(OBJECT, 1.4e-3, outline) for outline in held], [])
    true = _true_outline(settings, truth)
    parts["simulated"] = DrawnPart([(GOAL, 0.6e-3, outline) for outline in true], [])
    return parts


# Picture coordinates are in cells from the corner of the first cell. x counts columns, and y counts
# rows. In the sensor's axes, the footprint for displacement d and outward normal n is an ellipse.
# Let h = a − d and ρ² = 2ad − d². The centre of the ellipse is h·(n_x, n_y). The semi-axes are ρ
# n_z along the tilt and ρ across the tilt. The pressure centroid is at (a − d/3)·(n_x, n_y). The
# centroid position is exact for any constant modulus, and a close approximation for a measured
# material law.


def grid_of(frame: TactileFrame) -> SensorGrid | None:
    """Return the grid of a ``hand/tactile`` message, or None if its fields are invalid."""
    more = (frame.pitch_y, frame.centre_x, frame.centre_y, frame.rotation)
    pitch_y, x, y, rotation = (value if math.isfinite(value) else 0.0 for value in more)
    pitches = frame.pitch, pitch_y or frame.pitch
    try:
        return SensorGrid(frame.rows, frame.cols, pitches, (x, y), rotation)
    except ValueError:
        return None


def footprint(
    grid: SensorGrid, radius: float, d: float, tilt_x: float, tilt_y: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return a contact's closed outline [n, 2] and centroid [2] in picture coordinates.

    ``radius`` and ``d`` are in m. The tilts about the finger's axes are in rad. Returns None if the
    values do not describe a contact.
    """
    if not 0.0 < d < radius or not math.isfinite(tilt_x) or not math.isfinite(tilt_y):
        return None
    n = np.array(grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y)))
    sine = math.hypot(*n)
    if sine >= 1.0:
        return None
    x, y = n / sine if sine > 0.0 else (1.0, 0.0)  # unit vector in the tilt direction
    across = math.sqrt(2.0 * radius * d - d * d)
    ellipse = across * _UNIT_CIRCLE * (math.sqrt(1.0 - sine * sine), 1.0)
    outline = (radius - d) * n + ellipse @ np.array([(x, y), (-y, x)])
    return on_picture(grid, outline), on_picture(grid, (radius - d / 3.0) * n)


def tip_circle(grid: SensorGrid, radius: float) -> FloatArray:
    """Return the tip's rim in picture coordinates, shape [n, 2]."""
    return on_picture(grid, radius * _UNIT_CIRCLE)


def on_picture(grid: SensorGrid, points: FloatArray) -> FloatArray:
    """Convert sensor coordinates [m] relative to the tip's centre to picture coordinates."""
    middle = np.array([0.5 * grid.cols, 0.5 * grid.rows])
    cells: FloatArray = (points + np.array(grid.centre)) / np.array(grid.pitches) + middle
    return cells
