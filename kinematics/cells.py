"""Integrals over one cell of the sensor, cut by the footprint's outline or not, as kernels.

The outline makes the integrand's second derivative jump, so each cell is cut into strips in y where
no strip has the outline entering or leaving through a side; in x each line ends on the outline.
Gauss-Legendre in both directions then converges exponentially. Towards the rim the springs' length
√(a² − x² − y²) goes to zero like a square root, so there the nodes are more, spaced in the angle.
"""

from __future__ import annotations

import math

from kinematics.footprint import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    FloatArray,
    Geometry,
    beyond_limit,
    extremes,
    line_span,
)
from kinematics.kernels import kernel
from kinematics.material import stress_at

# Strips of one cell: up to 2 crossings of the outline with each side, 2 more of the base plane with
# the face, the cell's own two ends.
MAX_BREAKS = 12


@kernel
def nodes_needed(a: float, half: float, far: float) -> int:
    """Gauss points in one direction for a relative 1e-7 in a cell, 0 where the angle must be used.

    ``far`` is the distance of the farthest point from the axis, ``half`` half the cell's longer
    side: the rim is a branch point at (a − far)/half half-lengths behind the cell's end.
    """
    t = (a - far) / half
    if t > 12.0:
        return 2
    if t > 4.5:
        return 3
    if t > 2.0:
        return 4
    if t > 1.0:
        return 6
    if t > 0.5:
        return 8
    return 0


@kernel
def line_stress(
    law: FloatArray,
    u: float,
    v: float,
    w: float,
    a: float,
    y: float,
    left: float,
    right: float,
    n: int,
) -> float:
    """∫ σ(ε) dx [Pa m] on the line ``y`` from ``left`` to ``right``, which lie in the footprint.

    With n = 0 the variable is the angle t of x = R sin t: σ(ε)√(a² − x² − y²) dt stays smooth at
    the rim where σ(ε) dx does not.
    """
    total = 0.0
    q = u - w * y
    rim = a * a - y * y
    if n > 0:
        width = right - left
        for k in range(n):
            x = left + width * GAUSS_NODES[n, k]
            strain = min(1.0 - (q - v * x) / math.sqrt(rim - x * x), 1.0)
            total += GAUSS_WEIGHTS[n, k] * stress_at(law, strain)
        return total * width
    radius = math.sqrt(rim)
    start = math.asin(max(left / radius, -1.0))
    width = math.asin(min(right / radius, 1.0)) - start
    m = 10
    for k in range(m):
        t = start + width * GAUSS_NODES[m, k]
        z = radius * math.cos(t)
        face = q - v * radius * math.sin(t)
        if z > 0.0:
            strain = min(1.0 - face / z, 1.0) if face > 0.0 else 1.0
            total += GAUSS_WEIGHTS[m, k] * stress_at(law, strain) * z
    return total * width


@kernel
def whole_cell_stress(
    law: FloatArray,
    u: float,
    v: float,
    w: float,
    a: float,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
) -> float:
    """Mean σ(ε) [Pa] of a cell that lies in the footprint."""
    far = math.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)))
    n = nodes_needed(a, 0.5 * max(x1 - x0, y1 - y0), far)
    m = n if n > 0 else 10
    total = 0.0
    for k in range(m):
        y = y0 + (y1 - y0) * GAUSS_NODES[m, k]
        total += GAUSS_WEIGHTS[m, k] * line_stress(law, u, v, w, a, y, x0, x1, n)
    return total / (x1 - x0)


@kernel
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


@kernel
def cut_cell_stress(
    law: FloatArray,
    u: float,
    v: float,
    w: float,
    a: float,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    breaks: FloatArray,
) -> float:
    """Mean σ(ε) [Pa] of a cell that the outline may cut; ``breaks`` [MAX_BREAKS] is scratch."""
    ends = extremes(u, v, w, a)
    low = max(y0, ends[0])
    high = min(y1, ends[1])
    if not low < high:
        return 0.0
    breaks[0] = low
    breaks[1] = high
    count = 2
    for x in (x0, x1):
        below, above = line_span(u, w, v, a, x)
        count = _insert(breaks, count, below, low, high)
        count = _insert(breaks, count, above, low, high)
    beyond = beyond_limit(u, v, w, a)
    if beyond and w != 0.0:
        count = _insert(breaks, count, (u - v * x0) / w, low, high)
        count = _insert(breaks, count, (u - v * x1) / w, low, high)
    if beyond:
        # Where the line face = base plane meets the rim the outline has a corner.
        slope = math.sqrt(v * v + w * w)
        foot = u / slope
        along = math.sqrt(max(a * a - foot * foot, 0.0))
        count = _insert(breaks, count, (w * foot + v * along) / slope, low, high)
        count = _insert(breaks, count, (w * foot - v * along) / slope, low, high)
    total = 0.0
    for piece in range(count - 1):
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
        # At the outline's lowest and highest point, and at the rim, lines end like a square root.
        rounded = n == 0 or start == ends[0] or start + length >= ends[1]
        m = 10 if n == 0 else max(n, 7) if rounded else max(n, 4)
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
            weight *= length
            inner = max(n, 4) if n > 0 else 0
            kink = (u - w * y) / v if beyond and v != 0.0 else math.inf
            if left < kink < right:
                total += weight * line_stress(law, u, v, w, a, y, left, kink, inner)
                total += weight * line_stress(law, u, v, w, a, y, kink, right, inner)
            else:
                total += weight * line_stress(law, u, v, w, a, y, left, right, inner)
    return total / ((x1 - x0) * (y1 - y0))


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
