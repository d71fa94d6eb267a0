"""Kernels that compute the outline of a tip's footprint on a grid of cells.

The forward model and the estimator share the geometry in this module. Lengths are in m. Positions
are in sensor axes, relative to the tip centre. The object's face is the plane ``n·(x, y, z) = h``
with ``h = a − d``. Above the base point (x, y), the height of the face is ``z = u − v x − w y``,
where

    u = h/n_z,  v = n_x/n_z,  w = n_y/n_z,

and the spring strain at this point is ``ε = 1 − (u − v x − w y)/√(a² − x² − y²)`` (eq. 2 of the
parallel-distributed model). The footprint, where ε > 0, is the projection of a flat disc and
therefore an ellipse. Beyond the model's domain, the rim truncates the ellipse. The footprint is
always convex.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import FloatArray, Record

Span = tuple[float, float]


class Grid(Record):
    """Grid of cells under a tip; lengths [m] in sensor axes, relative to the tip centre."""

    radius: float
    x: float  # x of the first cell's corner
    y: float
    pitch_x: float
    pitch_y: float
    rows: int
    cols: int


def axes(grid: Grid) -> tuple[FloatArray, FloatArray]:
    """Return x [cols] and y [rows] of the cell centres [m]."""
    x = grid.x + grid.pitch_x * (np.arange(grid.cols) + 0.5)
    return np.asarray(x), np.asarray(grid.y + grid.pitch_y * (np.arange(grid.rows) + 0.5))


class Face(Record):
    """Height of the object's face above the base, z = u − v x − w y."""

    u: float
    v: float
    w: float


@inner_kernel
def set_face(face: Face, a: float, d: float, n_x: float, n_y: float) -> None:
    """Set the face for displacement ``d`` and a normal (n_x, n_y, n_z) with n_z > 0."""
    n_z = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    face.u = (a - d) / n_z
    face.v = n_x / n_z
    face.w = n_y / n_z


@inner_kernel
def set_around(out: Face, face: Face, a: float, margin: float) -> None:
    """Set ``out`` to a face parallel to ``face`` whose footprint is wider by ``margin`` [m].

    The enlarged footprint is limited to the tip's rim.
    """
    c = math.sqrt(1.0 + face.v * face.v + face.w * face.w)
    h = face.u / c
    rho = min(max(math.sqrt(max(a * a - h * h, 0.0)) + margin, 0.0), a)
    out.u = math.copysign(math.sqrt(a * a - rho * rho), face.u) * c
    out.v = face.v
    out.w = face.w


@inner_kernel
def extremes(face: Face, a: float) -> Span:
    """Return the minimum and maximum y of the footprint, or (inf, −inf) if it is empty.

    Beyond the model's domain, the face cuts the base plane inside the rim. In this case, the result
    is the y range of the rim.
    """
    u = face.u
    w = face.w
    tilt = face.v * face.v + w * w
    if u <= 0.0 or u * u < tilt * a * a:
        return -a, a
    root = (1.0 + tilt) * a * a - u * u
    if root <= 0.0:
        return math.inf, -math.inf
    half = math.sqrt((1.0 + face.v * face.v) * root)
    return (u * w - half) / (1.0 + tilt), (u * w + half) / (1.0 + tilt)


@inner_kernel
def line_span(face: Face, a: float, y: float) -> Span:
    """Return the x range (left, right) of the footprint at ``y``, or (inf, −inf) if it is empty."""
    v = face.v
    rim = a * a - y * y
    if rim <= 0.0:
        return math.inf, -math.inf
    q = face.u - face.w * y
    e = 1.0 + v * v
    root = e * rim - q * q
    edge = math.sqrt(rim)
    if root <= 0.0:
        return (-edge, edge) if q < 0.0 else (math.inf, -math.inf)
    root = math.sqrt(root)
    left = (v * q - root) / e
    right = (v * q + root) / e
    # If a root lies below the base plane, the footprint ends at the rim instead.
    return -edge if q < v * left else left, edge if q < v * right else right


@inner_kernel
def steps(low: float, high: float, start: float, pitch: float, count: int) -> tuple[int, int]:
    """Return the index range of the intervals that overlap the span from low to high.

    The ``count`` intervals have width ``pitch`` and begin at ``start``.
    """
    if not low < high:
        return 0, 0
    first = min(max(math.floor((low - start) / pitch), 0), count)
    return first, min(max(math.ceil((high - start) / pitch), first), count)
