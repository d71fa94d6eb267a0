"""From a pressure grid to a first estimate: the contact's centroid and extent.

Kernels for the moments of the pressure over the footprint, and the relations between those and
(d, n). For a constant modulus they are closed:

    F = πE d²/cos θ,   centroid = (a − d/3)(n_x, n_y),
    trace of the covariance = d(4a − d)/6 − sin²θ d(12a − 5d)/36;

any other material enters by the ratios to them, tabled over d (`moment_ratios`).
"""

from __future__ import annotations

import math

import numpy as np

from kinematics.activity import neighbourhood
from kinematics.cells import LIVE
from kinematics.contact import Fingertip
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
from kinematics.material import Material

RATIO_POINTS = 33
RATIO_END = 0.8  # of the radius
_RATIO_TILT = 0.2  # rad at which the ratios are taken; they hardly depend on it


def moment_ratios(tip: Fingertip, material: Material) -> FloatArray:
    """Force, centroid and trace over the closed forms of E₀, float64 [RATIO_POINTS, 3], over d.

    Rows are evenly spaced from 0 to RATIO_END·a. Integrated over the flattened disc in polar
    coordinates at a tilt of 0.2 rad.
    """
    a = tip.radius
    table = np.ones((RATIO_POINTS, 3))
    if material.is_linear:
        return table
    radial, radial_weight = np.polynomial.legendre.leggauss(24)
    angle = 2.0 * math.pi * (np.arange(32) + 0.5) / 32
    s, c = math.sin(_RATIO_TILT), math.cos(_RATIO_TILT)
    for k, d in enumerate(np.linspace(0.0, RATIO_END, RATIO_POINTS) * a):
        depth = max(d, 1e-4 * a)
        h = a - depth
        rho = math.sqrt(depth * (2.0 * a - depth))
        r = rho * 0.5 * (radial + 1.0)[:, None]
        x = h * s + r * np.cos(angle) * c
        y = r * np.sin(angle)
        z = h * c - r * np.cos(angle) * s
        length2 = a * a - x * x - y * y
        strain = np.clip(1.0 - z / np.sqrt(np.maximum(length2, 1e-12)), 0.0, 1.0)
        pressure = material.stress(strain) * radial_weight[:, None] * r
        total = pressure.sum()
        mean = (pressure * x).sum() / total
        trace = (pressure * ((x - mean) ** 2 + y**2)).sum() / total
        force = total * c * (0.5 * rho) * (2.0 * math.pi / 32)
        table[k, 0] = force / (math.pi * material.reference_modulus * depth**2 / c)
        table[k, 1] = mean / (s * (a - depth / 3.0))
        table[k, 2] = trace / closed_trace(a, depth, s)
    return table


@kernel
def closed_trace(a: float, d: float, s: float) -> float:
    """Trace of the pressure's covariance [m²] for a constant modulus, s = sin θ."""
    return d * (4.0 * a - d) / 6.0 - s * s * d * (12.0 * a - 5.0 * d) / 36.0


@kernel
def _ratio(ratios: FloatArray, a: float, d: float, column: int) -> float:
    t = min(max(d / (RATIO_END * a), 0.0), 0.999999) * (RATIO_POINTS - 1)
    k = int(t)
    t -= k
    return float(ratios[k, column] * (1.0 - t) + ratios[k + 1, column] * t)


@fast_kernel
def _row_moments(
    row: FloatArray, live: FloatArray, level: float
) -> tuple[float, float, float, float]:
    """Σp, Σp k, Σp k² and the number of live cells of a row's part with p > level."""
    s0 = 0.0
    s1 = 0.0
    s2 = 0.0
    n = 0.0
    for k in range(row.shape[0]):
        value = row[k]
        weight = live[k]
        weight = weight if value > level else 0.0
        value = value if weight > 0.0 else 0.0
        x = float(k)
        s0 += value
        s1 += value * x
        s2 += value * x * x
        n += weight
    return s0, s1, s2, n


@kernel
def row_moments(
    frame: FloatArray, cells: FloatArray, i: int, first: int, last: int, level: float
) -> tuple[float, float, float, float]:
    """Σp, Σp j, Σp j² and the number of live cells first..last of row i with p > level."""
    s0, s1, s2, n = _row_moments(frame[i, first:last], cells[i, LIVE, first:last], level)
    return s0, s1 + first * s0, s2 + first * (2.0 * s1 + first * s0), n


@kernel
def footprint_moments(
    frame: FloatArray, cells: FloatArray, geometry: Geometry, u: float, v: float, w: float
) -> tuple[float, float, float, float, float]:
    """(Σp, centroid x, y, trace of the covariance, cells) over the cells that touch the footprint.

    Lengths in m from the tip's centre, the cells' own variance pitch²/12 already taken off.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    rows, cols = frame.shape
    ends = extremes(u, v, w, a)
    total = sum_x = sum_y = sum_xx = sum_yy = number = 0.0
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
            s0, s1, s2, n = row_moments(frame, cells, i, first, last, -math.inf)
            total += s0
            sum_x += s1
            sum_xx += s2
            sum_y += s0 * i
            sum_yy += s0 * (i * i)
            number += n
    if not total > 0.0:
        return 0.0, 0.0, 0.0, 0.0, number
    mean_x = sum_x / total
    mean_y = sum_y / total
    return (
        total,
        x_first + pitch_x * (mean_x + 0.5),
        y_first + pitch_y * (mean_y + 0.5),
        pitch_x * pitch_x * (sum_xx / total - mean_x * mean_x - 1.0 / 12.0)
        + pitch_y * pitch_y * (sum_yy / total - mean_y * mean_y - 1.0 / 12.0),
        number,
    )


@kernel
def from_extent(a: float, trace: float, reach: float, ratios: FloatArray) -> float:
    """d from the trace of the pressure's covariance and the centroid's distance ``reach``."""
    d = 2.0 * a - math.sqrt(max(4.0 * a * a - 6.0 * max(trace, 0.0), a * a))
    for _ in range(6):
        s = min(reach / (_ratio(ratios, a, d, 1) * (a - d / 3.0)), 0.95)
        slope = (4.0 * a - 2.0 * d) / 6.0 - s * s * (12.0 * a - 10.0 * d) / 36.0
        miss = closed_trace(a, d, s) - trace / _ratio(ratios, a, d, 2)
        d = min(max(d - miss / slope, 0.0), 0.95 * a)
    return d


@kernel
def coarse(
    frame: FloatArray,
    cells: FloatArray,
    geometry: Geometry,
    runs: IntArray,
    level: float,
    row: int,
    col: int,
) -> tuple[float, float, float]:
    """(d, n_x, n_y) from the cells above ``level`` in the tip's disc: their centroid and number."""
    total = sum_x = sum_y = number = 0.0
    for i in range(frame.shape[0]):
        s0, s1, _, n = row_moments(frame, cells, i, runs[i, 0], runs[i, 1], level)
        total += s0
        sum_x += s1
        sum_y += s0 * i
        number += n
    if not total > 0.0:
        total, sum_x, sum_y, number = 1.0, float(col), float(row), 1.0
    return _from_area(geometry, sum_x / total, sum_y / total, number)


@kernel
def coarse_weak(
    frame: FloatArray,
    cells: FloatArray,
    geometry: Geometry,
    runs: IntArray,
    level: float,
    patch_level: float,
    row: int,
    col: int,
) -> tuple[float, float, float]:
    """As :func:`coarse` for pressures of a few times the noise, where lone cells mislead.

    Takes the cells above ``level`` whose neighbourhood stands above ``patch_level``, both in the
    frame's unit.
    """
    total = sum_x = sum_y = number = 0.0
    for i in range(frame.shape[0]):
        for j in range(runs[i, 0], runs[i, 1]):
            value = frame[i, j]
            if (
                value > level
                and cells[i, LIVE, j] > 0.0
                and neighbourhood(frame, cells, i, j) > patch_level
            ):
                total += value
                sum_x += value * j
                sum_y += value * i
                number += 1.0
    if not total > 0.0:
        total, sum_x, sum_y, number = 1.0, float(col), float(row), 1.0
    # Of a weak contact's cells about three quarters pass.
    return _from_area(geometry, sum_x / total, sum_y / total, 1.3 * number)


@kernel
def _from_area(
    geometry: Geometry, col: float, row: float, number: float
) -> tuple[float, float, float]:
    """(d, n_x, n_y) of a contact of so many cells round a place [cells]."""
    a, x_first, y_first, pitch_x, pitch_y = geometry
    x = x_first + pitch_x * (col + 0.5)
    y = y_first + pitch_y * (row + 0.5)
    # The footprint's area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * pitch_x * pitch_y / math.pi, 0.75 * a * a)
    d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    n_x, n_y = bounded(x / (a - d / 3.0), y / (a - d / 3.0))
    return d, n_x, n_y


@kernel
def bounded(n_x: float, n_y: float) -> tuple[float, float]:
    """(n_x, n_y) shortened to at most 0.95."""
    length = math.hypot(n_x, n_y)
    if length > 0.95:
        return 0.95 * n_x / length, 0.95 * n_y / length
    return n_x, n_y


@kernel
def refine(
    frame: FloatArray,
    cells: FloatArray,
    geometry: Geometry,
    ratios: FloatArray,
    modulus: float,
    fixed_gain: float,
    noise: float,
    d: float,
    n_x: float,
    n_y: float,
    covariance: FloatArray,
) -> tuple[float, float, float, float]:
    """(d, n_x, n_y, gain) from the moments over the footprint of the contact given, a cell wider.

    ``modulus`` E₀ and ``noise`` are in the frame's unit. With ``fixed_gain`` > 0 the displacement
    comes from the force, otherwise from the extent and the gain from the force. ``covariance``
    float64 [16] takes that of (d, n_x, n_y, gain) from white noise over those cells; the gain is 0
    where nothing presses.
    """
    a = geometry[0]
    margin = math.hypot(geometry[3], geometry[4]) * 0.5
    rho = min(math.sqrt(max(d * (2.0 * a - d), 0.0)) + margin, 0.99 * a)
    u, v, w = plane(a, a - math.sqrt(a * a - rho * rho), n_x, n_y)
    total, x, y, trace, number = footprint_moments(frame, cells, geometry, u, v, w)
    covariance[:] = 0.0
    if not total > 0.0:
        return d, n_x, n_y, 0.0
    force = total * geometry[3] * geometry[4]
    cosine = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    relative = noise * noise * number / (total * total)  # variance of the force over its square
    if fixed_gain > 0.0:
        plain = force * cosine / (math.pi * modulus * fixed_gain)
        for _ in range(4):
            d = math.sqrt(plain / _ratio(ratios, a, d, 0))
            d = min(max(d, 1e-4 * a), 0.95 * a)
        covariance[0] = 0.25 * relative * d * d
        gain = fixed_gain
    else:
        d = max(from_extent(a, trace, math.hypot(x, y), ratios), 1e-4 * a)
    reach = _ratio(ratios, a, d, 1) * (a - d / 3.0)
    n_x, n_y = bounded(x / reach, y / reach)
    if fixed_gain <= 0.0:
        cosine = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
        gain = force * cosine / (math.pi * modulus * d * d * _ratio(ratios, a, d, 0))
        # Over a disc of that many cells: mean of (r² − trace)².
        square = number * geometry[3] * geometry[4] / math.pi
        spread = square * square / 3.0 - trace * square + trace * trace
        slope = (4.0 * a - 2.0 * d) / 6.0
        covariance[0] = relative * spread / (slope * slope)
        covariance[15] = gain * gain * (relative + 4.0 * covariance[0] / (d * d))
        covariance[3] = -2.0 * gain * covariance[0] / d
        covariance[12] = covariance[3]
    covariance[5] = relative * 0.25 * rho * rho / (reach * reach)
    covariance[10] = covariance[5]
    return d, n_x, n_y, gain
