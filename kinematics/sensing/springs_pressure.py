"""Forward model of a spring tip on a grid of cells: pressure and its partials.

A cell's pressure is the mean over sample points that are evenly distributed over the cell. The
spring above a base point (x, y) has the length ℓ = √(a² − x² − y²). The strain of the spring is ε =
1 − z/ℓ with z = u − v x − w y; see `footprint`. Each sample point represents a small rectangle and
uses the rectangle's mean strain. Inside the footprint, the mean strain is computed from tabulated
means of 1/ℓ, x/ℓ and y/ℓ. If the outline cuts the rectangle, only the part with f = ℓ² − z² > 0
contributes. In such a rectangle, f is approximated as linear, and the values of f as uniformly
distributed.

The point weights include the sensor's blur; see `blur`.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from softfinger.kinematics.compiled.kernel import index, inlined_kernel, inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray, Records
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.blur import axis_points
from softfinger.kinematics.sensing.footprint import (
    Face,
    Grid,
    Span,
    extremes,
    line_span,
    set_around,
    steps,
)

STRESS, BY_D, BY_X, BY_Y = range(4)  # planes: pressure [Pa] and its ∂/∂d, ∂/∂n_x and ∂/∂n_y
PLANES = 4
POINT_X, STRAIN, SLOPE, FACTOR, POINT_STRESS = range(5)  # rows of `SpringPoints.line`
Cells = tuple[int, int]  # half-open range
_SPREAD_MIN = 1e-12
# Gauss-Legendre rule for the rectangle around a point, scaled to a width of 1.
_NODES, _WEIGHTS = (0.5 * each for each in np.polynomial.legendre.leggauss(3))


class SpringPoints(NamedTuple):
    """Sample points of a grid under a tip, in the memory layout that the kernels use.

    Each array stores one row of points: first the first point of every cell, then the second point
    of every cell, and so on. Cells outside the grid are included if they are within the range of
    the blur.
    """

    line: FloatArray  # [5, row]: distance from the tip centre in x [m], then scratch values
    inverse: FloatArray  # means of 1/ℓ, x/ℓ and y/ℓ [3, all rows]
    y: FloatArray  # one value per row
    across: FloatArray  # weights along x [position, cell offset], see `blur.axis_points`
    along: FloatArray  # weights along y
    law: FloatArray  # coefficients of the material's σ(ε), in ascending order of power
    sums: FloatArray  # scratch, three rows of cells [3, cells]


def points_of(cells: Grid, material: Material, blur: float, count: tuple[int, int]) -> SpringPoints:
    """Return the sample points of the cells, with ``count`` (x, y) points per cell side."""
    a = cells.radius
    x, across = axis_points(cells.x, cells.pitch_x, cells.cols, count[0], blur)
    y, along = axis_points(cells.y, cells.pitch_y, cells.rows, count[1], blur)
    x, y = x.ravel(), np.ascontiguousarray(y.T).ravel()
    size_x, size_y = cells.pitch_x / count[0], cells.pitch_y / count[1]
    inverse = np.zeros((3, len(y), len(x)))
    inside = np.zeros((len(y), len(x)))
    for (at_x, weight_x), (at_y, weight_y) in product(zip(_NODES, _WEIGHTS, strict=True), repeat=2):
        right, up = x + at_x * size_x, (y + at_y * size_y)[:, None]
        square = a * a - right * right - up * up
        weight = np.where(square > 0.0, weight_x * weight_y, 0.0)
        inside += weight
        each = weight / np.sqrt(np.where(square > 0.0, square, 1.0))
        inverse += each, each * right, each * up
    inverse /= np.where(inside > 0.0, inside, 1.0)
    line = np.zeros((5, len(x)))
    line[0] = x
    flat = inverse.reshape(3, -1)
    return SpringPoints(line, flat, y, across, along, material.law, np.zeros((3, cells.cols)))


@inlined_kernel
def _set_strains(
    points: SpringPoints,
    row: int,
    first: int,
    last: int,
    y: float,
    face: Face,
    a2: float,
    half: Span,
) -> None:
    """Set ε and −∂ε/∂u of the points from ``first`` to ``last`` in the row that begins at ``row``.

    ``half`` contains half the side lengths of a point's rectangle. Indices are unsigned. Numba
    checks signed indices for negative values, which prevents vectorisation.
    """
    u = face.u
    v = face.v
    w = face.w
    size_x, size_y = half
    rim = a2 - y * y
    least = _SPREAD_MIN * a2 * math.sqrt(a2)
    line = points.line
    for k in range(first, last):
        x = line[POINT_X, k]
        # The strain ε is positive where f = ℓ² − z² > 0. Even beyond the rim, f is almost linear.
        z = max(u - v * x - w * y, 0.0)
        f = rim - x * x - z * z
        # Approximate the width of the uniform distribution of f. The exact width is 4 (big +
        # small²/(3 big)). For a linear f and an outline through the centre, the approximate width
        # changes the mean of max(f, 0) by at most 2 %.
        by_x = abs(size_x * (x - z * v))
        by_y = abs(size_y * (y - z * w))
        big = max(by_x, by_y)
        small = min(by_x, by_y)
        spread = 4.0 * max(big, max(0.963 * big + 0.222 * small, 0.77 * big + 0.556 * small))
        part = min(max(f + 0.5 * spread, 0.0), spread)
        # Compute z in the middle of the part with f > 0. The direction in which f decreases is (p,
        # q).
        p = x - z * v
        q = y - z * w
        away = 0.5 * max(0.5 * part - f, 0.0) / (p * p + q * q + least)
        z = max(z + away * (v * p + w * q), 0.0)
        # Compute the means of ε and 1/ℓ for f uniformly distributed from 0 to ``part``.
        length = math.sqrt(z * z + part)
        mean = part / (spread * (length + z) + least)
        g = points.inverse[0, row + k]
        whole = 1.0 - (u * g - v * points.inverse[1, row + k] - w * points.inverse[2, row + k])
        cut = part < spread
        strain = (length - z) * mean if cut else whole
        slope = 2.0 * mean if cut else g
        line[STRAIN, k] = min(max(strain, 0.0), 1.0)
        line[SLOPE, k] = slope if (strain < 1.0) & (z > 0.0) else 0.0


@inlined_kernel
def _raise_power(line: FloatArray, first: int, last: int, coefficient: float) -> None:
    """Perform one step of Horner's scheme for σ(ε) and its derivative."""
    for k in range(first, last):
        strain = line[STRAIN, k]
        line[FACTOR, k] = line[FACTOR, k] * strain + line[POINT_STRESS, k]
        line[POINT_STRESS, k] = line[POINT_STRESS, k] * strain + coefficient


@inlined_kernel
def _sum_points(points: SpringPoints, first: int, last: int, ahead: int, weight: float) -> None:
    """Add the points that are ``ahead`` indices away to the sums of cells ``first`` to ``last``.

    The three sums are the stress σ, −∂σ/∂u and −x ∂σ/∂u.
    """
    line = points.line
    for k in range(first, last):
        slope = weight * line[SLOPE, ahead + k] * line[FACTOR, ahead + k]
        points.sums[0, k] += weight * line[POINT_STRESS, ahead + k]
        points.sums[1, k] += slope
        points.sums[2, k] += slope * line[POINT_X, ahead + k]


@inlined_kernel
def _press_line(
    points: SpringPoints, i: int, first: int, last: int, face: Face, a2: float, half: Span
) -> Cells:
    """Evaluate a line of points over cells ``first`` to ``last``; add up the points of each cell.

    Returns the range of affected cells.
    """
    places, reach = points.across.shape
    wide = points.line.shape[1] // places
    cols = points.sums.shape[1]
    law = points.law
    order = law.shape[0]
    low = max(first - reach + 1, 0)
    high = min(last, cols)
    points.sums[:, low:high] = 0.0
    row = index(i * places * wide)
    for m in range(places):
        begin = index(m * wide + first)
        end = index(m * wide + last)
        _set_strains(points, row, begin, end, points.y[i], face, a2, half)
        points.line[FACTOR:, begin:end] = 0.0
        for j in range(order - 1, -1, -1):
            _raise_power(points.line, begin, end, law[j])
        for q in range(reach):
            start = max(first - q, 0)
            count = min(last - q, cols) - start
            ahead = index(m * wide + q)
            _sum_points(points, index(start), index(start + count), ahead, points.across[m, q])
    return low, high


@inlined_kernel
def _add_row(
    points: SpringPoints,
    low: int,
    high: int,
    weight: float,
    y: float,
    face: Face,
    row: int,
    out: FloatArray,
) -> None:
    """Add a line's sums to a row of cells, as pressure, ∂/∂d, ∂/∂n_x and ∂/∂n_y."""
    u = face.u
    v = face.v
    w = face.w
    c = weight * math.sqrt(1.0 + v * v + w * w)
    for j in range(low, high):
        # Partials of the pressure with respect to −u, v and w.
        by_u = points.sums[1, j]
        by_v = points.sums[2, j]
        by_w = y * by_u
        along = v * by_v + w * by_w - u * by_u
        out[STRESS, row, j] += weight * points.sums[0, j]
        out[BY_D, row, j] += c * by_u
        out[BY_X, row, j] += c * (by_v + v * along)
        out[BY_Y, row, j] += c * (by_w + w * along)


@inner_kernel
def press_springs(
    points: SpringPoints, grid: Grid, face: Face, around: Face, out: FloatArray
) -> Cells:
    """Compute the pressure and its partials [PLANES, rows, cols]; return the range of changed rows.

    The remaining rows are left unchanged. ``around`` is scratch memory.
    """
    a = grid.radius
    count_x = points.across.shape[0]
    count_y, reach = points.along.shape
    size_x = 0.5 * grid.pitch_x / count_x
    size_y = 0.5 * grid.pitch_y / count_y
    # Widen the footprint, because the outline may cut a rectangle whose centre is outside.
    set_around(around, face, a, math.hypot(size_x, size_y))
    low, high = extremes(around, a)
    lines = points.y.shape[0]
    first_line, last_line = steps(low, high, points.y[0] - size_y, 2.0 * size_y, lines)
    first_row = min(max(first_line // count_y - reach + 1, 0), grid.rows)
    last_row = min((last_line + count_y - 1) // count_y, grid.rows)
    if not first_row < last_row or first_line == last_line:
        return 0, 0
    out[:, first_row:last_row] = 0.0
    start = points.line[POINT_X, 0] - size_x
    wide = points.line.shape[1] // count_x
    for i in range(first_line, last_line):
        y = points.y[i]
        left, right = line_span(around, a, y)
        first, last = steps(left, right, start, grid.pitch_x, wide)
        if first == last:
            continue
        begin, end = _press_line(points, i, first, last, face, a * a, (size_x, size_y))
        for q in range(reach):
            row = i // count_y - q
            if first_row <= row < last_row:
                weight = points.along[i % count_y, q]
                _add_row(points, begin, end, weight, y, face, row, out)
    return first_row, last_row


@kernel
def render(
    faces: Records[Face], grids: Records[Grid], planes: FloatArray, points: SpringPoints
) -> Cells:
    """Run :func:`press_springs` with the first of ``faces``; the second is scratch memory."""
    return press_springs(points, grids[0], faces[0], faces[1], planes)


def count_for(cells: Grid, fineness: float) -> tuple[int, int]:
    """Return the points per cell side (x, y) for ``fineness`` points per tip radius."""
    per_length = fineness / cells.radius
    x, y = (
        max(math.ceil(pitch * per_length - 1e-9), 1) for pitch in (cells.pitch_x, cells.pitch_y)
    )
    return x, y


class SpringsPressure:
    """Pressure model of a spring tip on a grid of cells, with ``count`` (x, y) points per cell."""

    def __init__(
        self, cells: Grid, material: Material, blur: float, count: tuple[int, int]
    ) -> None:
        self._radius = cells.radius
        self._grid = cells.array
        self._points = points_of(cells, material, blur, count)
        self._faces = np.zeros(2, Face.dtype)
        self._planes = np.zeros((PLANES, cells.rows, cells.cols))

    def __call__(self, contact: tuple[float, float, float], gain: float, out: FloatArray) -> None:
        """Write the pressure [Pa] of a ``contact`` (d, n_x, n_y), scaled by ``gain``, to ``out``.

        The result is zero for d ≤ 0. Beyond the model's domain, the footprint ends at the rim.
        """
        d, n_x, n_y = contact
        out[:] = 0.0
        n_z = 1.0 - n_x * n_x - n_y * n_y
        if not (d > 0.0 and n_z > 0.0):
            return
        n_z = math.sqrt(n_z)
        self._faces[0] = (self._radius - min(d, self._radius)) / n_z, n_x / n_z, n_y / n_z
        first, last = render(self._faces, self._grid, self._planes, self._points)
        np.multiply(gain, self._planes[STRESS, first:last], out=out[first:last])
