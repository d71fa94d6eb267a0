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

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import Record
from softfinger.kinematics.compiled.simd import Pointer

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Span = tuple[float, float]

MAX_NODES = 12


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
    """The object's face over the base, z = u − v x − w y, and the footprint's extreme points.

    Without a footprint ``low`` is inf and ``high`` −inf; beyond the limit both are the rim's.
    """

    u: float
    v: float
    w: float
    low: float  # y of the lowest point
    high: float
    left: float  # x of the leftmost point, and its y
    left_y: float
    right: float
    right_y: float


def _gauss_table() -> tuple[FloatArray, FloatArray]:
    nodes = np.zeros((MAX_NODES + 1, MAX_NODES))
    weights = np.zeros((MAX_NODES + 1, MAX_NODES))
    for n in range(1, MAX_NODES + 1):
        x, weight = np.polynomial.legendre.leggauss(n)
        nodes[n, :n] = 0.5 * (x + 1.0)
        weights[n, :n] = 0.5 * weight
    return nodes, weights


# Gauss-Legendre rules on [0, 1], row n holds the n-point rule.
GAUSS_NODES, GAUSS_WEIGHTS = _gauss_table()


@inner_kernel
def set_face(face: Face, a: float, d: float, n_x: float, n_y: float) -> None:
    """Set the face pressed in by ``d``; the z component of its normal (n_x, n_y, …) is positive."""
    n_z = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    face.u = (a - d) / n_z
    face.v = n_x / n_z
    face.w = n_y / n_z


@inner_kernel
def beyond_limit(face: Face, a: float) -> bool:
    """Return whether the face cuts the base plane inside the rim, that is |θ| > θ_lim(d)."""
    u = face.u
    return u <= 0.0 or u * u < (face.v * face.v + face.w * face.w) * a * a


@inner_kernel
def set_extremes(face: Face, a: float) -> None:
    """Find the footprint's extreme points."""
    u = face.u
    v = face.v
    w = face.w
    face.left_y = face.right_y = 0.0
    s = 1.0 + v * v + w * w
    if s * a * a <= u * u and u > 0.0:
        face.low = face.left = math.inf
        face.high = face.right = -math.inf
    elif beyond_limit(face, a):
        face.low = face.left = -a
        face.high = face.right = a
    else:
        root = s * a * a - u * u
        half_length = math.sqrt((1.0 + v * v) * root)
        face.low = (u * w - half_length) / s
        face.high = (u * w + half_length) / s
        half_length = math.sqrt((1.0 + w * w) * root)
        left = (u * v - half_length) / s
        right = (u * v + half_length) / s
        e = 1.0 + w * w
        face.left = left
        face.left_y = w * (u - v * left) / e
        face.right = right
        face.right_y = w * (u - v * right) / e


@inner_kernel
def line_span(u: float, v: float, w: float, a: float, y: float) -> Span:
    """Return the ends (left, right) in x of the footprint on the line ``y``; (inf, −inf) for none.

    To cut along a line of constant x instead, exchange v and w.
    """
    rim = a * a - y * y
    if rim <= 0.0:
        return math.inf, -math.inf
    q = u - w * y
    e = 1.0 + v * v
    root = e * rim - q * q
    if root <= 0.0:
        if q < 0.0:
            half = math.sqrt(rim)
            return -half, half
        return math.inf, -math.inf
    root = math.sqrt(root)
    left = (v * q - root) / e
    right = (v * q + root) / e
    # A root under the base plane is no edge: there the spring is gone and the rim is the edge.
    if q < v * left:
        left = -math.sqrt(rim)
    if q < v * right:
        right = math.sqrt(rim)
    return left, right


@fast_inner_kernel
def line_spans(
    face: Face, grid: Grid, upright: bool, first: int, last: int, left: Pointer, right: Pointer
) -> None:
    """Evaluate :func:`line_span` on grid lines first..last, of x if ``upright``, else of y."""
    a = grid.radius
    u = face.u
    v = face.w if upright else face.v
    w = face.v if upright else face.w
    start = grid.x if upright else grid.y
    pitch = grid.pitch_x if upright else grid.pitch_y
    norm2 = 1.0 + v * v
    e = 1.0 / norm2
    for k in range(first, last + 1):
        y = start + k * pitch
        rim = a * a - y * y
        q = u - w * y
        square = norm2 * rim - q * q
        root = math.sqrt(max(square, 0.0))
        edge = math.sqrt(max(rim, 0.0))
        near = (v * q - root) * e
        far = (v * q + root) * e
        near = -edge if (q < v * near) | (square <= 0.0) else near
        far = edge if (q < v * far) | (square <= 0.0) else far
        none = (rim <= 0.0) | ((square <= 0.0) & (q >= 0.0))
        left[k] = math.inf if none else near
        right[k] = -math.inf if none else far


@inner_kernel
def rows_touched(face: Face, grid: Grid) -> tuple[int, int]:
    """Return the range of the rows that the footprint touches."""
    first = min(max(math.floor((face.low - grid.y) / grid.pitch_y), 0), grid.rows)
    last = min(max(math.ceil((face.high - grid.y) / grid.pitch_y), first), grid.rows)
    return first, last


@inner_kernel
def cols_touched(face: Face, grid: Grid) -> tuple[int, int]:
    """Return the range of the columns that the footprint touches."""
    first = min(max(math.floor((face.left - grid.x) / grid.pitch_x), 0), grid.cols)
    last = min(max(math.ceil((face.right - grid.x) / grid.pitch_x), first), grid.cols)
    return first, last


@inner_kernel
def band_columns(
    face: Face, grid: Grid, below: Span, above: Span, y0: float, y1: float
) -> tuple[int, int, int, int]:
    """Return columns (a, b, c, d) of the band y0..y1: a..d touch the footprint, b..c lie inside.

    ``below`` and ``above`` are the spans at y0 and y1. Cells a..b and c..d may be cut by the
    outline, and beyond the limit some of them lie outside.
    """
    a = grid.radius
    if beyond_limit(face, a):
        nearest = 0.0 if y0 * y1 <= 0.0 else min(abs(y0), abs(y1))
        outer_right = math.sqrt(max(a * a - nearest * nearest, 0.0))
        outer_left = -outer_right
    else:
        outer_left = min(below[0], above[0])
        outer_right = max(below[1], above[1])
        if y0 <= face.left_y <= y1:
            outer_left = face.left
        if y0 <= face.right_y <= y1:
            outer_right = face.right
    if not outer_left < outer_right:
        return 0, 0, 0, 0
    x_first = grid.x
    per_pitch = 1.0 / grid.pitch_x
    first = min(max(math.floor((outer_left - x_first) * per_pitch), 0), grid.cols)
    last = min(max(math.ceil((outer_right - x_first) * per_pitch), first), grid.cols)
    inner_left = max(below[0], above[0])
    inner_right = min(below[1], above[1])
    if not inner_left < inner_right:
        return first, last, last, last
    inner_first = max(math.ceil((inner_left - x_first) * per_pitch), first)
    inner_last = min(math.floor((inner_right - x_first) * per_pitch), last)
    if inner_first >= inner_last:
        return first, last, last, last
    return first, inner_first, inner_last, last
