"""Integrals over one cell of the sensor, cut by the footprint's outline or not, as kernels.

The outline makes the integrand's second derivative jump, so each cell is cut into strips in y where
no strip has the outline entering or leaving through a side; in x each line ends on the outline.
Gauss-Legendre in both directions then converges exponentially. Towards the rim the springs' length
√(a² − x² − y²) goes to zero like a square root, so there the nodes are more, spaced in the angle.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel, kernel
from softfinger.kinematics.contact.material import stress_at
from softfinger.kinematics.sensing.footprint import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    Ends,
    FloatArray,
    Geometry,
    Span,
    beyond_limit,
    line_span,
)

# Strips of one cell: up to 2 crossings of the outline with each side, 2 more of the base plane with
# the face, the cell's own two ends.
MAX_BREAKS = 12

# Rows of the nodes.
X, Y, WEIGHT, STRAIN, STRESS = range(5)
NODE_ROWS = 5
ANGLE_NODES = 10
NODES_A_CELL = (MAX_BREAKS - 1) * ANGLE_NODES * 2 * ANGLE_NODES


@inner_kernel
def nodes_needed(a: float, half: float, far: float) -> int:
    """Gauss points a direction that keep a cell well within 1e-6 E; 0 where the angle is needed.

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
def push_line(
    nodes: FloatArray, count: int, a: float, y: float, left: float, right: float, n: int, w: float
) -> int:
    """Add the nodes of ∫ dx on the line ``y`` from ``left`` to ``right``, times ``w``.

    ``nodes`` has the rows X, Y and WEIGHT. With n = 0 the variable is the angle t of x = R sin t:
    σ(ε)√(a² − x² − y²) dt stays smooth at the rim where σ(ε) dx does not.
    """
    if n > 0:
        width = right - left
        for k in range(n):
            nodes[X, count] = left + width * GAUSS_NODES[n, k]
            nodes[Y, count] = y
            nodes[WEIGHT, count] = w * width * GAUSS_WEIGHTS[n, k]
            count += 1
        return count
    radius = math.sqrt(a * a - y * y)
    start = math.asin(max(left / radius, -1.0))
    width = math.asin(min(right / radius, 1.0)) - start
    for k in range(ANGLE_NODES):
        t = start + width * GAUSS_NODES[ANGLE_NODES, k]
        nodes[X, count] = radius * math.sin(t)
        nodes[Y, count] = y
        nodes[WEIGHT, count] = w * width * GAUSS_WEIGHTS[ANGLE_NODES, k] * radius * math.cos(t)
        count += 1
    return count


@inner_kernel
def push_whole(
    nodes: FloatArray, count: int, a: float, x0: float, x1: float, y0: float, y1: float
) -> int:
    """Add the nodes of the mean over a cell that lies in the footprint."""
    far = math.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)))
    n = nodes_needed(a, 0.5 * max(x1 - x0, y1 - y0), far)
    m = n if n > 0 else ANGLE_NODES
    scale = 1.0 / (x1 - x0)
    for k in range(m):
        y = y0 + (y1 - y0) * GAUSS_NODES[m, k]
        count = push_line(nodes, count, a, y, x0, x1, n, GAUSS_WEIGHTS[m, k] * scale)
    return count


@fast_inner_kernel
def _strains(nodes: FloatArray, count: int, u: float, v: float, w: float, a: float) -> None:
    for k in range(count):
        x = nodes[X, k]
        y = nodes[Y, k]
        length2 = max(a * a - x * x - y * y, 1e-30)
        nodes[STRAIN, k] = min(max(1.0 - (u - v * x - w * y) / math.sqrt(length2), 0.0), 1.0)


@fast_inner_kernel
def _polynomial(nodes: FloatArray, count: int, coefficients: FloatArray) -> None:
    order = coefficients.shape[0]
    for k in range(count):
        nodes[STRESS, k] = coefficients[order - 1]
    for j in range(order - 2, -1, -1):
        c = coefficients[j]
        for k in range(count):
            nodes[STRESS, k] = nodes[STRESS, k] * nodes[STRAIN, k] + c


@inner_kernel
def evaluate(
    nodes: FloatArray, count: int, u: float, v: float, w: float, a: float, law: FloatArray
) -> None:
    """Fill the rows STRAIN, at most 1, and STRESS of the first ``count`` nodes, in SIMD lanes."""
    _strains(nodes, count, u, v, w, a)
    if law.shape[0] == 1:
        _polynomial(nodes, count, law[0])
    else:
        for k in range(count):
            nodes[STRESS, k] = stress_at(law, nodes[STRAIN, k])


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
def push_cut(
    nodes: FloatArray,
    count: int,
    u: float,
    v: float,
    w: float,
    a: float,
    ends: Ends,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    left_span: Span,
    right_span: Span,
    breaks: FloatArray,
) -> int:
    """Add the nodes of the mean over a cell that the outline may cut.

    ``ends`` are the footprint's :func:`extremes`, the spans its parts on the lines x0 and x1;
    ``breaks`` [MAX_BREAKS] is scratch.
    """
    low = max(y0, ends[0])
    high = min(y1, ends[1])
    if not low < high:
        return count
    breaks[0] = low
    breaks[1] = high
    number = 2
    for span in (left_span, right_span):
        number = _insert(breaks, number, span[0], low, high)
        number = _insert(breaks, number, span[1], low, high)
    beyond = beyond_limit(u, v, w, a)
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
        near = min(start - ends[0], ends[1] - start - length)
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
                count = push_line(nodes, count, a, y, left, kink, inner, weight)
                left = kink
            count = push_line(nodes, count, a, y, left, right, inner, weight)
    return count


# Planes of a grid's cells, float64 [rows, CELL_PLANES, cols]: means over the whole cell of g, x g
# and y g with g = 1/√(a² − x² − y²), their covariances, and 1 for a live cell, 0 for a dead one.
PLAIN_MEAN, X_MEAN, Y_MEAN, LIVE, PLAIN_VAR, PLAIN_X, PLAIN_Y, X_VAR, X_Y, Y_VAR = range(10)
CELL_PLANES = 10
_MEAN_NODES = 8


@kernel
def face_integrals(geometry: Geometry, out: FloatArray) -> None:
    """Fill the planes of ``out`` [rows, CELL_PLANES, cols] but LIVE.

    The strain's mean over a whole cell in the footprint is exactly 1 − u ḡ + v (xg) + w (yg), and
    its variance the same form's in the covariances. A cell that the rim cuts never lies in the
    footprint and stays 0.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    rows, _, cols = out.shape
    n = _MEAN_NODES
    for i in range(rows):
        y0 = y_first + i * pitch_y
        for j in range(cols):
            x0 = x_first + j * pitch_x
            x_far = max(abs(x0), abs(x0 + pitch_x))
            if x_far * x_far + max(abs(y0), abs(y0 + pitch_y)) ** 2 >= a * a:
                continue
            for k in range(n):
                y = y0 + pitch_y * GAUSS_NODES[n, k]
                for m in range(n):
                    x = x0 + pitch_x * GAUSS_NODES[n, m]
                    weight = GAUSS_WEIGHTS[n, k] * GAUSS_WEIGHTS[n, m]
                    g = 1.0 / math.sqrt(a * a - x * x - y * y)
                    out[i, PLAIN_MEAN, j] += weight * g
                    out[i, X_MEAN, j] += weight * g * x
                    out[i, Y_MEAN, j] += weight * g * y
                    weight *= g * g
                    out[i, PLAIN_VAR, j] += weight
                    out[i, PLAIN_X, j] += weight * x
                    out[i, PLAIN_Y, j] += weight * y
                    out[i, X_VAR, j] += weight * x * x
                    out[i, X_Y, j] += weight * x * y
                    out[i, Y_VAR, j] += weight * y * y
            g = out[i, PLAIN_MEAN, j]
            g_x = out[i, X_MEAN, j]
            g_y = out[i, Y_MEAN, j]
            out[i, PLAIN_VAR, j] -= g * g
            out[i, PLAIN_X, j] -= g * g_x
            out[i, PLAIN_Y, j] -= g * g_y
            out[i, X_VAR, j] -= g_x * g_x
            out[i, X_Y, j] -= g_x * g_y
            out[i, Y_VAR, j] -= g_y * g_y
