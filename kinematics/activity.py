"""Whether anything presses on a pressure grid, cheaply, and whether it can be one contact.

Kernels that look at readings and noise alone; no displacement or tilt comes from here.
"""

from __future__ import annotations

import math

from kinematics.cells import LIVE
from kinematics.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    band_columns,
    extremes,
    line_span,
    plane,
)
from kinematics.kernels import fast_kernel, kernel


@fast_kernel
def _row_scan(row: FloatArray, live: FloatArray, level: float) -> tuple[float, float, float]:
    """Number of live cells of a row above ``level``, their sum all, which tells NaN, and number."""
    over = 0.0
    total = 0.0
    number = 0.0
    for j in range(row.shape[0]):
        value = row[j]
        mask = live[j]
        value = value if mask > 0.0 else 0.0
        over += 1.0 if value > level else 0.0
        total += value
        number += mask
    return over, total, number


@kernel
def neighbourhood(frame: FloatArray, cells: FloatArray, i: int, j: int) -> float:
    """How far the 5 × 5 cells round (i, j), without the middle one, stand above noise 1.

    Weights (1, 2, 2, 2, 1) both ways; the sum over its standard deviation.
    """
    rows, cols = frame.shape
    total = 0.0
    squares = 1e-30
    for k in range(max(i - 2, 0), min(i + 3, rows)):
        row_weight = 1.0 if abs(k - i) == 2 else 2.0
        for m in range(max(j - 2, 0), min(j + 3, cols)):
            if cells[k, LIVE, m] > 0.0 and not (k == i and m == j):
                weight = row_weight if abs(m - j) == 2 else 2.0 * row_weight
                total += weight * frame[k, m]
                squares += weight * weight
    return total / math.sqrt(squares)


@kernel
def activity(
    frame: FloatArray,
    cells: FloatArray,
    runs: IntArray,
    noise: float,
    peak_level: float,
    patch_level: float,
) -> tuple[bool, int, int, float, float, bool]:
    """Cheap test: (contact, row and column of the largest cell, that cell, mean, finite).

    ``noise`` is a cell's standard deviation in the frame's unit. A contact is a cell above
    ``peak_level`` · noise whose neighbours' weighted sum, itself left out, passes ``patch_level``
    standard deviations: one hot cell alone is none. ``runs`` [rows, 2] are the columns inside the
    tip's disc.
    """
    level = peak_level * noise
    contact = False
    row = -1
    col = -1
    peak = 0.0
    total = 0.0
    number = 0.0
    for i in range(frame.shape[0]):
        first = runs[i, 0]
        last = runs[i, 1]
        over, row_sum, row_number = _row_scan(
            frame[i, first:last], cells[i, LIVE, first:last], level
        )
        total += row_sum
        number += row_number
        if over > 0.0:
            for j in range(first, last):
                value = frame[i, j]
                if value > level and cells[i, LIVE, j] > 0.0:
                    if value > peak:
                        peak = value
                        row = i
                        col = j
                    if not contact:
                        contact = neighbourhood(frame, cells, i, j) > patch_level * noise
    mean = total / max(number, 1.0)
    return contact, row, col, peak, mean, math.isfinite(total) and math.isfinite(peak)


@kernel
def is_spike(
    frame: FloatArray, cells: FloatArray, i: int, j: int, noise: float, confined: float
) -> bool:
    """Whether the cell stands alone as no contact can: a hot cell.

    ``confined`` is what a contact about as wide as a cell could press at most: a wider one never
    has a cell that stands at twice its neighbours.
    """
    rows, cols = frame.shape
    total = 0.0
    number = 0
    for k, m in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
        if 0 <= k < rows and 0 <= m < cols and cells[k, LIVE, m] > 0.0:
            total += frame[k, m]
            number += 1
    if number == 0:
        return False
    return bool(
        frame[i, j] > 10.0 * noise + confined
        and frame[i, j] > 2.0 * max(total, 0.0) / number + 12.0 * noise
    )


@kernel
def presses_outside(
    frame: FloatArray,
    cells: FloatArray,
    geometry: Geometry,
    runs: IntArray,
    level: float,
    d: float,
    n_x: float,
    n_y: float,
) -> bool:
    """Whether a cell above ``level``, and not it alone, lies two cells off the footprint.

    ``level`` is in the frame's unit; the neighbours' weighted mean must reach a third of it.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    cols = frame.shape[1]
    rho = math.sqrt(max(d * (2.0 * a - d), 0.0)) + 2.0 * math.hypot(pitch_x, pitch_y)
    if rho >= 0.99 * a:
        return False
    u, v, w = plane(a, a - math.sqrt(a * a - rho * rho), n_x, n_y)
    ends = extremes(u, v, w, a)
    for i in range(frame.shape[0]):
        y0 = y_first + i * pitch_y
        below = line_span(u, v, w, a, y0)
        above = line_span(u, v, w, a, y0 + pitch_y)
        first, _, _, last = band_columns(
            u, v, w, a, ends, below, above, y0, y0 + pitch_y, x_first, pitch_x, cols
        )
        for j in range(runs[i, 0], runs[i, 1]):
            if (first <= j < last) or not cells[i, LIVE, j] > 0.0:
                continue
            # Σ w = 60 and √Σ w² = 13.4 over a whole neighbourhood.
            if frame[i, j] > level and neighbourhood(frame, cells, i, j) > 1.5 * level:
                return True
    return False
