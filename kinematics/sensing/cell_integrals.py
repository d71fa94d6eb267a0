"""Integrals over one cell of the sensor, cut by the footprint's outline or not, as kernels.

The outline makes the integrand's second derivative jump, so each cell is cut into strips in y where
no strip has the outline entering or leaving through a side; in x each line ends on the outline.
Gauss-Legendre in both directions then converges exponentially. Towards the rim the springs' length
√(a² − x² − y²) goes to zero like a square root, so there the nodes are more, spaced in the angle.
"""

from __future__ import annotations

import math
from typing import Annotated, TypeAlias

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.layout import Record
from softfinger.kinematics.sensing.footprint import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    Face,
    FloatArray,
    Grid,
    Span,
    beyond_limit,
    line_span,
)

# Strips of one cell: up to 2 crossings of the outline with each side, 2 more of the base plane with
# the face, the cell's own two ends.
MAX_BREAKS = 12

ANGLE_NODES = 10
NODES_A_CELL = (MAX_BREAKS - 1) * ANGLE_NODES * 2 * ANGLE_NODES
NODES = 512 + NODES_A_CELL

Values: TypeAlias = Annotated[FloatArray, NODES]


class Nodes(Record):
    """Nodes of the integrals over cells, and what the springs there say."""

    count: int
    x: Values  # [m]
    y: Values
    weight: Values
    strain: Values
    stress: Values  # [Pa]
    breaks: Annotated[FloatArray, MAX_BREAKS]  # scratch


@inner_kernel
def nodes_needed(a: float, half: float, far: float) -> int:
    """Return the Gauss points a direction that keep a cell within 1e-6 E; 0 if the angle is needed.

    ``far`` is the distance of the farthest point from the axis, ``half`` half the cell's longer
    side: the rim is a branch point at (a − far)/half half-lengths behind the cell's end.
    """
    t = (a - far) / half
    if t > 18.0:
        return 2
    if t > 6.0:
        return 3
    if t > 3.0:
        return 4
    if t > 1.3:
        return 6
    if t > 0.7:
        return 8
    return 0


@inner_kernel
def _add_line(
    nodes: Nodes, a: float, y: float, left: float, right: float, n: int, w: float
) -> None:
    """Add the nodes of ∫ dx on the line ``y`` from ``left`` to ``right``, times ``w``.

    With n = 0 the variable is the angle t of x = R sin t: σ(ε)√(a² − x² − y²) dt stays smooth at
    the rim where σ(ε) dx does not.
    """
    count = nodes.count
    if n > 0:
        width = right - left
        for k in range(n):
            nodes.x[count] = left + width * GAUSS_NODES[n, k]
            nodes.y[count] = y
            nodes.weight[count] = w * width * GAUSS_WEIGHTS[n, k]
            count += 1
    else:
        radius = math.sqrt(a * a - y * y)
        start = math.asin(max(left / radius, -1.0))
        width = math.asin(min(right / radius, 1.0)) - start
        for k in range(ANGLE_NODES):
            t = start + width * GAUSS_NODES[ANGLE_NODES, k]
            nodes.x[count] = radius * math.sin(t)
            nodes.y[count] = y
            nodes.weight[count] = w * width * GAUSS_WEIGHTS[ANGLE_NODES, k] * radius * math.cos(t)
            count += 1
    nodes.count = count


@inner_kernel
def add_whole_cell(nodes: Nodes, grid: Grid, i: int, j: int) -> None:
    """Add the nodes of the mean over a cell that lies in the footprint."""
    a = grid.radius
    x0 = grid.x + j * grid.pitch_x
    x1 = grid.x + (j + 1) * grid.pitch_x
    y0 = grid.y + i * grid.pitch_y
    y1 = grid.y + (i + 1) * grid.pitch_y
    far = math.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)))
    n = nodes_needed(a, 0.5 * max(x1 - x0, y1 - y0), far)
    m = n if n > 0 else ANGLE_NODES
    scale = 1.0 / (x1 - x0)
    for k in range(m):
        y = y0 + (y1 - y0) * GAUSS_NODES[m, k]
        _add_line(nodes, a, y, x0, x1, n, GAUSS_WEIGHTS[m, k] * scale)


@fast_inner_kernel
def _strains(nodes: Nodes, face: Face, a: float) -> None:
    u = face.u
    v = face.v
    w = face.w
    for k in range(nodes.count):
        x = nodes.x[k]
        y = nodes.y[k]
        length2 = max(a * a - x * x - y * y, 1e-30)
        nodes.strain[k] = min(max(1.0 - (u - v * x - w * y) / math.sqrt(length2), 0.0), 1.0)


@fast_inner_kernel
def _polynomial(nodes: Nodes, coefficients: FloatArray) -> None:
    order = coefficients.shape[0]
    for k in range(nodes.count):
        nodes.stress[k] = coefficients[order - 1]
    for j in range(order - 2, -1, -1):
        c = coefficients[j]
        for k in range(nodes.count):
            nodes.stress[k] = nodes.stress[k] * nodes.strain[k] + c


@inner_kernel
def evaluate(nodes: Nodes, face: Face, a: float, law: FloatArray) -> None:
    """Evaluate strain, at most 1, and stress at the nodes, in SIMD lanes."""
    _strains(nodes, face, a)
    _polynomial(nodes, law)


@inner_kernel
def _insert(breaks: FloatArray, count: int, value: float, low: float, high: float) -> int:
    """Put ``value`` into the sorted ``breaks`` if it lies between ``low`` and ``high``."""
    if not (low < value < high):
        return count
    k = count
    while k > 0 and breaks[k - 1] > value:
        breaks[k] = breaks[k - 1]
        k -= 1
    breaks[k] = value
    return count + 1


@inner_kernel
def add_cut_cell(
    nodes: Nodes, face: Face, grid: Grid, i: int, j: int, left_span: Span, right_span: Span
) -> None:
    """Add the nodes of the mean over a cell that the outline may cut.

    The spans are the footprint's parts on the lines of the cell's left and right side.
    """
    a = grid.radius
    u = face.u
    v = face.v
    w = face.w
    x0 = grid.x + j * grid.pitch_x
    x1 = grid.x + (j + 1) * grid.pitch_x
    y0 = grid.y + i * grid.pitch_y
    y1 = grid.y + (i + 1) * grid.pitch_y
    breaks = nodes.breaks
    low = max(y0, face.low)
    high = min(y1, face.high)
    if not low < high:
        return
    breaks[0] = low
    breaks[1] = high
    number = 2
    for span in (left_span, right_span):
        number = _insert(breaks, number, span[0], low, high)
        number = _insert(breaks, number, span[1], low, high)
    beyond = beyond_limit(face, a)
    if beyond and w != 0.0:
        number = _insert(breaks, number, (u - v * x0) / w, low, high)
        number = _insert(breaks, number, (u - v * x1) / w, low, high)
    if beyond:
        # Where the line face = base plane meets the rim the outline has a corner.
        slope = math.sqrt(v * v + w * w)
        foot = u / slope
        along = math.sqrt(max(a * a - foot * foot, 0.0))
        number = _insert(breaks, number, (w * foot + v * along) / slope, low, high)
        number = _insert(breaks, number, (w * foot - v * along) / slope, low, high)
    scale = 1.0 / ((x1 - x0) * (y1 - y0))
    for piece in range(number - 1):
        start = breaks[piece]
        length = breaks[piece + 1] - start
        if length <= 1e-9 * (y1 - y0):
            continue
        left, right = line_span(u, v, w, a, start + 0.5 * length)
        if min(right, x1) <= max(left, x0):
            continue
        y_far = max(abs(start), abs(start + length))
        x_far = max(abs(max(left, x0)), abs(min(right, x1)))
        n = nodes_needed(a, 0.5 * max(x1 - x0, y1 - y0), math.hypot(x_far, y_far))
        # Near the outline's lowest and highest point, and the rim, lines end like a square root.
        near = min(start - face.low, face.high - start - length)
        rounded = n == 0 or near < 0.5 * length
        m = ANGLE_NODES if n == 0 else max(n, 7) if rounded else max(n, 4)
        for k in range(m):
            t = GAUSS_NODES[m, k]
            weight = GAUSS_WEIGHTS[m, k]
            if rounded:
                weight *= 0.5 * math.pi * math.sin(math.pi * t)
                t = 0.5 - 0.5 * math.cos(math.pi * t)
            y = start + length * t
            left, right = line_span(u, v, w, a, y)
            left = max(left, x0)
            right = min(right, x1)
            if left >= right:
                continue
            weight *= length * scale
            inner = max(n, 4) if n > 0 else 0
            kink = (u - w * y) / v if beyond and v != 0.0 else math.inf
            if left < kink < right:
                _add_line(nodes, a, y, left, kink, inner, weight)
                left = kink
            _add_line(nodes, a, y, left, right, inner, weight)


# Planes of a grid's cells, float64 [rows, CELL_PLANES, cols]: means over the whole cell of g, x g
# and y g with g = 1/√(a² − x² − y²), their covariances, and 1 for a live cell, 0 for a dead one.
PLAIN_MEAN, X_MEAN, Y_MEAN, ACTIVE, PLAIN_VAR, PLAIN_X, PLAIN_Y, X_VAR, X_Y, Y_VAR = range(10)
CELL_PLANES = 10
_MEAN_NODES = 8


def cell_integrals(grid: Grid) -> FloatArray:
    """Return the planes of a grid's cells, all but LIVE.

    The strain's mean over a whole cell in the footprint is exactly 1 − u ḡ + v (xg) + w (yg), and
    its variance the same form's in the covariances. A cell that the rim cuts never lies in the
    footprint and stays 0.
    """
    a = grid.radius
    x0 = grid.x + np.arange(grid.cols) * grid.pitch_x
    y0 = grid.y + np.arange(grid.rows) * grid.pitch_y
    x_far = np.maximum(np.abs(x0), np.abs(x0 + grid.pitch_x))
    y_far = np.maximum(np.abs(y0), np.abs(y0 + grid.pitch_y))
    rows, cols = np.nonzero(x_far * x_far + (y_far**2)[:, None] < a * a)
    x0, y0 = x0[cols], y0[rows]
    out = np.zeros((CELL_PLANES, rows.size))
    for k in range(_MEAN_NODES):
        y = y0 + grid.pitch_y * GAUSS_NODES[_MEAN_NODES, k]
        for m in range(_MEAN_NODES):
            x = x0 + grid.pitch_x * GAUSS_NODES[_MEAN_NODES, m]
            weight = GAUSS_WEIGHTS[_MEAN_NODES, k] * GAUSS_WEIGHTS[_MEAN_NODES, m]
            g = 1.0 / np.sqrt(a * a - x * x - y * y)
            once, twice = weight * g, weight * (g * g)
            along_x, along_y = twice * x, twice * y
            out[PLAIN_MEAN] += once
            out[X_MEAN] += once * x
            out[Y_MEAN] += once * y
            out[PLAIN_VAR] += twice
            out[PLAIN_X] += along_x
            out[PLAIN_Y] += along_y
            out[X_VAR] += along_x * x
            out[X_Y] += along_x * y
            out[Y_VAR] += along_y * y
    g, g_x, g_y = out[[PLAIN_MEAN, X_MEAN, Y_MEAN]]
    out[[PLAIN_VAR, PLAIN_X, PLAIN_Y]] -= g * g, g * g_x, g * g_y
    out[[X_VAR, X_Y, Y_VAR]] -= g_x * g_x, g_x * g_y, g_y * g_y
    planes = np.zeros((grid.rows, CELL_PLANES, grid.cols))
    planes[rows, :, cols] = out.T
    return planes
