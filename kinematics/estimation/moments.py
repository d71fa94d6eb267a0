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

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import (
    FIRST,
    LAST,
    X,
    Y,
    next_above,
    sums_above,
    sums_inside,
)
from softfinger.kinematics.estimation.detection import neighbourhood
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    extremes,
    plane,
)

# How much wider than the footprint the cells' middles are looked for, in a cell's diagonals: so all
# that touch it are in, even where the contact moved a little.
_MARGIN = 0.75
_BLUR_MARGIN = 2.0  # and in standard deviations of the blur

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


@inner_kernel
def _ratio(ratios: FloatArray, a: float, d: float, column: int) -> float:
    t = min(max(d / (RATIO_END * a), 0.0), 0.999999) * (RATIO_POINTS - 1)
    k = int(t)
    t -= k
    return float(ratios[k, column] * (1.0 - t) + ratios[k + 1, column] * t)


@inner_kernel
def footprint_moments(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
    geometry: Geometry,
    u: float,
    v: float,
    w: float,
    own: float,
) -> tuple[float, float, float, float, float]:
    """(Σp, centroid x, y, trace of the covariance, cells) over the cells that the face presses.

    Those whose middle lies in the footprint of (u, v, w). Lengths in m from the tip's centre;
    ``own`` [m²] is the trace of a point's own spread over cells, which is taken off.
    """
    a, _, y_first, _, pitch_y = geometry
    rows, cols = frame.shape
    total = sum_x = sum_y = square = number = 0.0
    ends = extremes(u, v, w, a)
    if ends[0] < ends[1]:
        # Only the rows of the footprint's box.
        first_row = min(max(math.floor((ends[0] - y_first) / pitch_y), 0), rows)
        last_row = min(max(math.ceil((ends[1] - y_first) / pitch_y), first_row), rows)
        total, sum_x, sum_y, square, number = sums_inside(
            address(frame),
            address(middles),
            rows * cols,
            max(first_row * cols, bounds[FIRST]),
            min(last_row * cols, bounds[LAST]),
            u,
            v,
            w,
        )
    if not total > 0.0:
        return 0.0, 0.0, 0.0, 0.0, number
    x = sum_x / total
    y = sum_y / total
    return total, x, y, square / total - x * x - y * y - own, number


@inner_kernel
def from_extent(a: float, trace: float, reach: float, ratios: FloatArray, start: float) -> float:
    """d from the trace of the pressure's covariance and the centroid's distance ``reach``.

    Newton's iteration from d = ``start``; its last step is below 1e-5 of the radius, so that what
    is left is of 1e-10.
    """
    d = min(max(start, 0.01 * a), 0.9 * a)
    for _ in range(8):
        s = min(reach / (_ratio(ratios, a, d, 1) * (a - d / 3.0)), 0.95)
        slope = (4.0 * a - 2.0 * d) / 6.0 - s * s * (12.0 * a - 10.0 * d) / 36.0
        miss = closed_trace(a, d, s) - trace / _ratio(ratios, a, d, 2)
        before = d
        d = min(max(d - miss / slope, 0.0), 0.95 * a)
        if abs(d - before) < 1e-5 * a:
            break
    return d


@inner_kernel
def coarse(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
    geometry: Geometry,
    level: float,
    row: int,
    col: int,
) -> tuple[float, float, float]:
    """(d, n_x, n_y) from the cells above ``level``: their centroid and number.

    (row, col) is the largest cell, taken where there is no other.
    """
    rows, cols = frame.shape
    total, sum_x, sum_y, number = sums_above(
        address(frame), address(middles), rows * cols, bounds[FIRST], bounds[LAST], level
    )
    if not total > 0.0:
        at = row * cols + col
        total, sum_x, sum_y, number = 1.0, middles[X, at], middles[Y, at], 1.0
    return _from_area(geometry, sum_x / total, sum_y / total, number)


@inner_kernel
def coarse_weak(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
    geometry: Geometry,
    level: float,
    patch_level: float,
    row: int,
    col: int,
) -> tuple[float, float, float]:
    """As :func:`coarse` for pressures of a few times the noise, where lone cells mislead.

    Takes the cells of ``level`` or more whose neighbourhood stands above ``patch_level``, both in
    the frame's unit.
    """
    rows, cols = frame.shape
    readings = address(frame)
    height = address(middles)
    last = bounds[LAST]
    total = sum_x = sum_y = number = 0.0
    at = next_above(readings, height, bounds[FIRST], last, level)
    while at < last:
        if neighbourhood(readings, height, rows, cols, at // cols, at % cols) > patch_level:
            value = readings[at]
            total += value
            sum_x += value * middles[X, at]
            sum_y += value * middles[Y, at]
            number += 1.0
        at = next_above(readings, height, at + 1, last, level)
    if not total > 0.0:
        at = row * cols + col
        total, sum_x, sum_y, number = 1.0, middles[X, at], middles[Y, at], 1.0
    # Of a weak contact's cells about three quarters pass.
    return _from_area(geometry, sum_x / total, sum_y / total, 1.3 * number)


@inner_kernel
def _from_area(geometry: Geometry, x: float, y: float, number: float) -> tuple[float, float, float]:
    """(d, n_x, n_y) of a contact of so many cells round a place [m]."""
    a, _, _, pitch_x, pitch_y = geometry
    # The footprint's area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * pitch_x * pitch_y / math.pi, 0.75 * a * a)
    d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    n_x, n_y = bounded(x / (a - d / 3.0), y / (a - d / 3.0))
    return d, n_x, n_y


@inner_kernel
def bounded(n_x: float, n_y: float) -> tuple[float, float]:
    """(n_x, n_y) shortened to at most 0.95."""
    length = math.hypot(n_x, n_y)
    if length > 0.95:
        return 0.95 * n_x / length, 0.95 * n_y / length
    return n_x, n_y


@inner_kernel
def refine(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
    geometry: Geometry,
    ratios: FloatArray,
    modulus: float,
    fixed_gain: float,
    noise: float,
    blur: float,
    d: float,
    n_x: float,
    n_y: float,
    covariance: FloatArray,
) -> tuple[float, float, float, float]:
    """(d, n_x, n_y, gain) from the moments over the footprint of the contact given, a cell wider.

    ``blur`` [m] is the standard deviation of a point's spread, besides the cells' own pitch²/12.

    ``modulus`` E₀ and ``noise`` are in the frame's unit. With ``fixed_gain`` > 0 the displacement
    comes from the force, otherwise from the extent and the gain from the force. ``covariance``
    float64 [16] takes that of (d, n_x, n_y, gain) from white noise over those cells; the gain is 0
    where nothing presses.
    """
    a = geometry[0]
    margin = _MARGIN * math.hypot(geometry[3], geometry[4]) + _BLUR_MARGIN * blur
    rho = min(math.sqrt(max(d * (2.0 * a - d), 0.0)) + margin, 0.99 * a)
    u, v, w = plane(a, a - math.sqrt(a * a - rho * rho), n_x, n_y)
    own = (geometry[3] * geometry[3] + geometry[4] * geometry[4]) / 12.0 + 2.0 * blur * blur
    moments = footprint_moments(frame, middles, bounds, geometry, u, v, w, own)
    covariance[:] = 0.0
    gain = 0.0
    if moments[0] > 0.0:
        d, n_x, n_y, gain = _contact(
            moments, geometry, ratios, modulus, fixed_gain, noise, d, n_x, n_y, rho, covariance
        )
    return d, n_x, n_y, gain


@inner_kernel
def _contact(
    moments: tuple[float, float, float, float, float],
    geometry: Geometry,
    ratios: FloatArray,
    modulus: float,
    fixed_gain: float,
    noise: float,
    d: float,
    n_x: float,
    n_y: float,
    rho: float,
    covariance: FloatArray,
) -> tuple[float, float, float, float]:
    """What :func:`refine` gives, from what :func:`footprint_moments` gave within ``rho``."""
    a = geometry[0]
    total, x, y, trace, number = moments
    force = total * geometry[3] * geometry[4]
    cosine = math.sqrt(1.0 - n_x * n_x - n_y * n_y)
    relative = noise * noise * number / (total * total)  # variance of the force over its square
    gain = fixed_gain
    if fixed_gain > 0.0:
        plain = force * cosine / (math.pi * modulus * fixed_gain)
        for _ in range(4):
            d = math.sqrt(plain / _ratio(ratios, a, d, 0))
            d = min(max(d, 1e-4 * a), 0.95 * a)
        covariance[0] = 0.25 * relative * d * d
    else:
        d = max(from_extent(a, trace, math.hypot(x, y), ratios, d), 1e-4 * a)
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
