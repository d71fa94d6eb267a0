"""Where the pressed tip touches: the footprint's outline on a grid of cells, as kernels.

Holds the geometry that the forward model and the estimator share, and no pressure. Lengths are m in
the sensor's axes, counted from the tip's centre. The object's face is the plane ``n·(x, y, z) = h``
with ``h = a − d``; over the base point (x, y) it stands at ``z = u − v x − w y`` where

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

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# (a, x and y of the first cell's corner from the tip's centre, pitch x, pitch y) [m].
Geometry = tuple[float, float, float, float, float]
Span = tuple[float, float]
Ends = tuple[float, float, float, float, float, float]
Crossings = tuple[float, float, float, float]

MAX_NODES = 12


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
def plane(a: float, d: float, n_x: float, n_y: float) -> tuple[float, float, float]:
    """(u, v, w) of the object's face; the normal's z component must be positive."""
    n_z = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    return (a - d) / n_z, n_x / n_z, n_y / n_z


@inner_kernel
def line_span(u: float, v: float, w: float, a: float, y: float) -> Span:
    """Ends (left, right) in x of the footprint on the line ``y``; (inf, −inf) if it has none.

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
    u: float,
    v: float,
    w: float,
    a: float,
    start: float,
    pitch: float,
    first: int,
    last: int,
    left: FloatArray,
    right: FloatArray,
) -> None:
    """:func:`line_span` on the lines y = start + k pitch, k = first..last, into left and right."""
    stretch = 1.0 + v * v
    e = 1.0 / stretch
    for k in range(first, last + 1):
        y = start + k * pitch
        rim = a * a - y * y
        q = u - w * y
        square = stretch * rim - q * q
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
def beyond_limit(u: float, v: float, w: float, a: float) -> bool:
    """Whether the face cuts the base plane inside the rim, that is |θ| > θ_lim(d)."""
    return u <= 0.0 or u * u < (v * v + w * w) * a * a


@inner_kernel
def extremes(u: float, v: float, w: float, a: float) -> Ends:
    """(y of the lowest, of the highest point, y and x of the leftmost, y and x of the rightmost).

    Empty (inf, −inf, …) when the face is off the tip. Beyond the limit the two y are the rim's.
    """
    inf = math.inf
    s = 1.0 + v * v + w * w
    if s * a * a <= u * u and u > 0.0:
        return inf, -inf, 0.0, inf, 0.0, -inf
    if beyond_limit(u, v, w, a):
        return -a, a, 0.0, -a, 0.0, a
    root = s * a * a - u * u
    reach = math.sqrt((1.0 + v * v) * root)
    low = (u * w - reach) / s
    high = (u * w + reach) / s
    reach = math.sqrt((1.0 + w * w) * root)
    left = (u * v - reach) / s
    right = (u * v + reach) / s
    e = 1.0 + w * w
    return low, high, w * (u - v * left) / e, left, w * (u - v * right) / e, right


@inner_kernel
def band_columns(
    u: float,
    v: float,
    w: float,
    a: float,
    ends: Ends,
    below: Span,
    above: Span,
    y0: float,
    y1: float,
    x_first: float,
    pitch_x: float,
    cols: int,
) -> tuple[int, int, int, int]:
    """Columns (a, b, c, d) of the cells in the band y0..y1: a..d touch the footprint, b..c lie in.

    ``ends`` is what :func:`extremes` gave, ``below`` and ``above`` the spans at y0 and y1. Cells
    a..b and c..d may be cut by the outline, and beyond the limit some of them lie outside.
    """
    if beyond_limit(u, v, w, a):
        nearest = 0.0 if y0 * y1 <= 0.0 else min(abs(y0), abs(y1))
        outer_right = math.sqrt(max(a * a - nearest * nearest, 0.0))
        outer_left = -outer_right
    else:
        outer_left = min(below[0], above[0])
        outer_right = max(below[1], above[1])
        if y0 <= ends[2] <= y1:
            outer_left = ends[3]
        if y0 <= ends[4] <= y1:
            outer_right = ends[5]
    if not outer_left < outer_right:
        return 0, 0, 0, 0
    per_pitch = 1.0 / pitch_x
    first = min(max(math.floor((outer_left - x_first) * per_pitch), 0), cols)
    last = min(max(math.ceil((outer_right - x_first) * per_pitch), first), cols)
    inner_left = max(below[0], above[0])
    inner_right = min(below[1], above[1])
    if not inner_left < inner_right:
        return first, last, last, last
    inner_first = max(math.ceil((inner_left - x_first) * per_pitch), first)
    inner_last = min(math.floor((inner_right - x_first) * per_pitch), last)
    if inner_first >= inner_last:
        return first, last, last, last
    return first, inner_first, inner_last, last
