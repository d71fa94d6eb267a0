"""From a pressure grid to a first estimate: is there a contact, its centroid and its extent.

Kernels for the activity test and for the moments of the pressure over the footprint, with the closed
relations between them and (d, n) for a constant modulus.
"""

from __future__ import annotations

import math

from kinematics.footprint import band_columns, extremes, line_span, plane
from kinematics.kernels import fast_kernel, kernel

LIVE = 3  # plane of ``cells`` that is 1 for a live cell and 0 for a dead one or one outside the tip


@kernel
def row_peak(frame, cells, i, first, last):
    """(largest, smallest, sum) of the live cells first..last of row i; the sum tells NaN and inf."""
    high = 0.0
    low = 0.0
    total = 0.0
    for j in range(first, last):
        value = frame[i, j] if cells[i, LIVE, j] > 0.0 else 0.0
        high = max(high, value)
        low = min(low, value)
        total += value
    return high, low, total


@kernel
def patch_sum(frame, cells, i, j):
    """Weighted sum over the 5 × 5 cells round (i, j), weights (1, 2, 2, 2, 1) ⊗ itself, and Σ w²."""
    rows, cols = frame.shape
    total = 0.0
    squares = 0.0
    for k in range(max(i - 2, 0), min(i + 3, rows)):
        row_weight = 1.0 if abs(k - i) == 2 else 2.0
        for m in range(max(j - 2, 0), min(j + 3, cols)):
            if cells[k, LIVE, m] > 0.0:
                weight = row_weight if abs(m - j) == 2 else 2.0 * row_weight
                total += weight * frame[k, m]
                squares += weight * weight
    return total, squares


@kernel
def activity(frame, cells, runs, noise, peak_level, patch_level):
    """Cheap test for a contact: (row, col, peak, lowest, finite); row is −1 without one.

    ``noise`` is a cell's standard deviation in the frame's unit. A contact is a cell above
    ``peak_level`` · noise whose neighbourhood's weighted sum passes ``patch_level`` standard
    deviations. ``runs`` [rows, 2] are the columns inside the tip's disc.
    """
    best = patch_level
    found_i = -1
    found_j = -1
    peak = 0.0
    lowest = 0.0
    total = 0.0
    for i in range(frame.shape[0]):
        first = runs[i, 0]
        last = runs[i, 1]
        high, low, row = row_peak(frame, cells, i, first, last)
        total += row
        lowest = min(lowest, low)
        peak = max(peak, high)
        if high > peak_level * noise:
            for j in range(first, last):
                if frame[i, j] > peak_level * noise and cells[i, LIVE, j] > 0.0:
                    patch, squares = patch_sum(frame, cells, i, j)
                    score = patch / (noise * math.sqrt(squares))
                    if score > best:
                        best = score
                        found_i = i
                        found_j = j
    return found_i, found_j, peak, lowest, math.isfinite(total) and math.isfinite(peak)


@fast_kernel
def row_moments(frame, cells, i, first, last, level):
    """Σp, Σp j, Σp j² and the number of live cells of row i with p > level."""
    s0 = 0.0
    s1 = 0.0
    s2 = 0.0
    n = 0.0
    for j in range(first, last):
        value = frame[i, j]
        weight = cells[i, LIVE, j] if value > level else 0.0
        value = value if weight > 0.0 else 0.0
        s0 += value
        s1 += value * j
        s2 += value * (j * j)
        n += weight
    return s0, s1, s2, n


@kernel
def footprint_moments(frame, cells, geometry, u, v, w):
    """(Σp, centroid x, y, variance x, y, covariance) over the cells that touch the footprint.

    Lengths in m from the tip's centre, the cells' own variance pitch²/12 already taken off.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    rows, cols = frame.shape
    ends = extremes(u, v, w, a)
    total = sum_x = sum_y = sum_xx = sum_xy = sum_yy = 0.0
    if ends[0] < ends[1]:
        first_row = min(max(math.floor((ends[0] - y_first) / pitch_y), 0), rows)
        last_row = min(max(math.ceil((ends[1] - y_first) / pitch_y), first_row), rows)
        above = line_span(u, v, w, a, y_first + first_row * pitch_y)
        for i in range(first_row, last_row):
            y0 = y_first + i * pitch_y
            below = above
            above = line_span(u, v, w, a, y0 + pitch_y)
            first, _, _, last = band_columns(
                u, v, w, a, ends, below, above, y0, y0 + pitch_y, x_first, pitch_x, cols
            )
            s0, s1, s2, _ = row_moments(frame, cells, i, first, last, -math.inf)
            total += s0
            sum_x += s1
            sum_xx += s2
            sum_y += s0 * i
            sum_yy += s0 * (i * i)
            sum_xy += s1 * i
    if not total > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mean_x = sum_x / total
    mean_y = sum_y / total
    return (
        total,
        x_first + pitch_x * (mean_x + 0.5),
        y_first + pitch_y * (mean_y + 0.5),
        pitch_x * pitch_x * (sum_xx / total - mean_x * mean_x - 1.0 / 12.0),
        pitch_y * pitch_y * (sum_yy / total - mean_y * mean_y - 1.0 / 12.0),
        pitch_x * pitch_y * (sum_xy / total - mean_x * mean_y),
    )


@kernel
def from_extent(a, trace, reach):
    """d from the trace of the pressure's covariance and the centroid's distance ``reach``.

    Solves d(4a − d)/6 − s² d(12a − 5d)/36 = trace with s = reach/(a − d/3).
    """
    d = 2.0 * a - math.sqrt(max(4.0 * a * a - 6.0 * max(trace, 0.0), a * a))
    for _ in range(8):
        s = min(reach / (a - d / 3.0), 0.95)
        slope = (4.0 * a - 2.0 * d) / 6.0 - s * s * (12.0 * a - 10.0 * d) / 36.0
        miss = d * (4.0 * a - d) / 6.0 - s * s * d * (12.0 * a - 5.0 * d) / 36.0 - trace
        d = min(max(d - miss / slope, 0.0), 0.95 * a)
    return d


@kernel
def coarse(frame, cells, geometry, runs, level, row, col):
    """(d, n_x, n_y) from the cells above ``level`` in the tip's disc: their centroid and number."""
    a, x_first, y_first, pitch_x, pitch_y = geometry
    total = sum_x = sum_y = number = 0.0
    for i in range(frame.shape[0]):
        s0, s1, _, n = row_moments(frame, cells, i, runs[i, 0], runs[i, 1], level)
        total += s0
        sum_x += s1
        sum_y += s0 * i
        number += n
    if not total > 0.0:
        total, sum_x, sum_y, number = 1.0, float(col), float(row), 1.0
    x = x_first + pitch_x * (sum_x / total + 0.5)
    y = y_first + pitch_y * (sum_y / total + 0.5)
    # The footprint's area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * pitch_x * pitch_y / math.pi, 0.75 * a * a)
    d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    reach = a - d / 3.0
    n_x, n_y = bounded(x / reach, y / reach)
    return d, n_x, n_y


@kernel
def bounded(n_x, n_y):
    """(n_x, n_y) shortened to at most 0.95."""
    length = math.hypot(n_x, n_y)
    if length > 0.95:
        return 0.95 * n_x / length, 0.95 * n_y / length
    return n_x, n_y


@kernel
def refine(frame, cells, geometry, modulus, d, n_x, n_y):
    """(d, n_x, n_y, gain) from the moments over the footprint of the contact given, one cell wider.

    ``modulus`` is in the frame's unit and turns the gain into measured over modelled force.
    """
    a = geometry[0]
    margin = math.hypot(geometry[3], geometry[4]) * 0.5
    rho = min(math.sqrt(max(d * (2.0 * a - d), 0.0)) + margin, 0.99 * a)
    wide = a - math.sqrt(a * a - rho * rho)
    u, v, w = plane(a, wide, n_x, n_y)
    total, x, y, xx, yy, _ = footprint_moments(frame, cells, geometry, u, v, w)
    if not total > 0.0:
        return d, n_x, n_y, 0.0
    d = from_extent(a, xx + yy, math.hypot(x, y))
    d = max(d, 1e-4 * a)
    reach = a - d / 3.0
    n_x, n_y = bounded(x / reach, y / reach)
    cosine = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    gain = total * geometry[3] * geometry[4] * cosine / (math.pi * modulus * d * d)
    return d, n_x, n_y, gain
