"""Outline of the footprint on a grid of cells, as kernels.

The geometry that the forward model and the estimator share; no pressure. Lengths are m in the
sensor's axes, from the tip's centre. The object's face is the plane ``n·(x, y, z) = h`` with
``h = a − d``; over the base point (x, y) it stands at ``z = u − v x − w y`` where

    u = h/n_z,  v = n_x/n_z,  w = n_y/n_z,

and the strain of the spring there is ``ε = 1 − (u − v x − w y)/√(a² − x² − y²)`` (eq. 2 of the
parallel-distributed model). The footprint {ε > 0} is the projection of a flat disc: an ellipse, or,
beyond the domain's limit, an ellipse cut by the rim; convex in both cases.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Record

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Span = tuple[float, float]


class Grid(Record):
    """A tip on a grid of cells: lengths [m] in the sensor's axes, from the tip's centre."""

    radius: float
    x: float  # of the first cell's corner
    y: float
    pitch_x: float
    pitch_y: float
    rows: int
    cols: int


class Face(Record):
    """The object's face over the base, z = u − v x − w y."""

    u: float
    v: float
    w: float


@inner_kernel
def set_face(face: Face, a: float, d: float, n_x: float, n_y: float) -> None:
    """Set the face pressed in by ``d``; the z component of its normal (n_x, n_y, …) is positive."""
    n_z = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    face.u = (a - d) / n_z
    face.v = n_x / n_z
    face.w = n_y / n_z


@inner_kernel
def set_around(out: Face, face: Face, a: float, margin: float) -> None:
    """Set a face parallel to ``face`` whose footprint, before the tilt, is wider by ``margin``.

    The wider one ends at the tip's rim.
    """
    c = math.sqrt(1.0 + face.v * face.v + face.w * face.w)
    h = face.u / c
    rho = min(max(math.sqrt(max(a * a - h * h, 0.0)) + margin, 0.0), a)
    out.u = math.copysign(math.sqrt(a * a - rho * rho), face.u) * c
    out.v = face.v
    out.w = face.w


@inner_kernel
def extremes(face: Face, a: float) -> Span:
    """Return y of the footprint's lowest and highest point; (inf, −inf) for none.

    Beyond the limit, where the face cuts the base plane within the rim, both are the rim's.
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
    """Return the footprint's ends (left, right) in x on the line ``y``; (inf, −inf) for none."""
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
    # A root under the base plane is no edge: there the spring is gone and the rim is the edge.
    return -edge if q < v * left else left, edge if q < v * right else right


@inner_kernel
def steps(low: float, high: float, start: float, pitch: float, count: int) -> tuple[int, int]:
    """Return the range of the intervals of ``pitch`` from ``start`` on that low … high touches."""
    if not low < high:
        return 0, 0
    first = min(max(math.floor((low - start) / pitch), 0), count)
    return first, min(max(math.ceil((high - start) / pitch), first), count)
