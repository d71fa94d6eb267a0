"""First estimate of a contact from a pressure grid's centroid and extent.

Kernels for the moments of the pressure over the footprint, and the relations between those and
(d, n). For a constant modulus they are closed:

    F = πE d²/cos θ,   centroid = (a − d/3)(n_x, n_y),
    trace of the covariance = d(4a − d)/6 − sin²θ d(12a − 5d)/36;

any other material enters by the ratios to them, tabled over d (`moment_ratios`).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, further
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import (
    X,
    Y,
    next_above,
    sums_above,
    sums_inside,
)
from softfinger.kinematics.estimation.detection import neighbourhood
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import RATIO_POINTS, EstimatorState, Moments
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Grid,
    IntArray,
    rows_touched,
    set_extremes,
    set_face,
)

# How much wider than the footprint the cells' centres are looked for, in a cell's diagonals: so all
# that touch it are in, even where the contact moved a little.
_MARGIN = 0.75
_BLUR_MARGIN = 2.0  # and in standard deviations of the blur

_RATIO_END = 0.8  # of the radius
_RATIO_TILT = 0.2  # rad at which the ratios are taken; they hardly depend on it

_WEAK = 15.0  # noise: a largest cell below is looked for together with its neighbours


def closed_trace(a: float, d: float, s: float) -> float:
    """Return the trace of the pressure's covariance [m²] for a constant modulus, s = sin θ."""
    return d * (4.0 * a - d) / 6.0 - s * s * d * (12.0 * a - 5.0 * d) / 36.0


_trace = inner_kernel(closed_trace)


@lru_cache(maxsize=4)
def moment_ratios(tip: Fingertip, material: Material) -> FloatArray:
    """Return force, centroid and trace over E₀'s closed forms, float64 [RATIO_POINTS, 3], over d.

    Rows are evenly spaced from 0 to 0.8 a. Integrated over the flattened disc in polar coordinates
    at a tilt of 0.2 rad.
    """
    if material.is_linear:
        return np.ones((RATIO_POINTS, 3))
    a = tip.radius
    radial, radial_weight = np.polynomial.legendre.leggauss(24)
    angle = 2.0 * math.pi * (np.arange(32) + 0.5) / 32
    s, c = math.sin(_RATIO_TILT), math.cos(_RATIO_TILT)
    depth = np.maximum(np.linspace(0.0, _RATIO_END, RATIO_POINTS) * a, 1e-4 * a)
    h = (a - depth)[:, None, None]
    rho = np.sqrt(depth * (2.0 * a - depth))
    r = rho[:, None, None] * 0.5 * (radial + 1.0)[:, None]
    x = h * s + r * np.cos(angle) * c
    y = r * np.sin(angle)
    z = h * c - r * np.cos(angle) * s
    length2 = a * a - x * x - y * y
    strain = np.clip(1.0 - z / np.sqrt(np.maximum(length2, 1e-12)), 0.0, 1.0)
    pressure = material.stress(strain) * radial_weight[:, None] * r

    def summed(values: FloatArray) -> FloatArray:
        return np.asarray(values.reshape(RATIO_POINTS, -1).sum(axis=1))

    total = summed(pressure)
    mean = summed(pressure * x) / total
    trace = summed(pressure * ((x - mean[:, None, None]) ** 2 + y**2)) / total
    force = total * c * (0.5 * rho) * (2.0 * math.pi / 32)
    ratios = (
        force / (math.pi * material.reference_modulus * depth**2 / c),
        mean / (s * (a - depth / 3.0)),
        trace / [closed_trace(a, each, s) for each in depth.tolist()],
    )
    return np.stack(ratios, axis=1)


@inner_kernel
def _ratio(m: Moments, a: float, d: float, column: int) -> float:
    t = min(max(d / (_RATIO_END * a), 0.0), 0.999999) * (RATIO_POINTS - 1)
    k = int(t)
    t -= k
    return float(m.ratios[k, column] * (1.0 - t) + m.ratios[k + 1, column] * t)


@inner_kernel
def footprint_moments(state: EstimatorState, frame: Pointer, centres: Pointer, own: float) -> None:
    """Sum the cells that ``moments.face`` presses: Σp, centroid, trace of the covariance, number.

    Those whose centre lies in the footprint; all 0 but the number where nothing presses. ``own``
    [m²] is the trace of a point's own blur over cells, which is subtracted.
    """
    m = state.moments
    grid = state.grid
    m.total = m.x = m.y = m.trace = m.number = 0.0
    set_extremes(m.face, grid.radius)
    if m.face.low < m.face.high:
        # Only the rows of the footprint's box.
        first_row, last_row = rows_touched(m.face, grid)
        first = max(first_row * grid.cols, state.region.first)
        last = min(last_row * grid.cols, state.region.last)
        sums_inside(m, frame, centres, grid.rows * grid.cols, first, last)
    if m.total > 0.0:
        x = m.x / m.total
        y = m.y / m.total
        m.trace = m.trace / m.total - x * x - y * y - own
        m.x = x
        m.y = y


@inner_kernel
def _d_from_extent(m: Moments, a: float, distance: float) -> float:
    """d from the trace of the pressure's covariance and the centroid's distance ``distance``.

    Newton's iteration from ``m.d``; its last step is below 1e-5 of the radius, so that what is left
    is of 1e-10.
    """
    d = min(max(m.d, 0.01 * a), 0.9 * a)
    for _ in range(8):
        s = min(distance / (_ratio(m, a, d, 1) * (a - d / 3.0)), 0.95)
        slope = (4.0 * a - 2.0 * d) / 6.0 - s * s * (12.0 * a - 10.0 * d) / 36.0
        miss = _trace(a, d, s) - m.trace / _ratio(m, a, d, 2)
        before = d
        d = min(max(d - miss / slope, 0.0), 0.95 * a)
        if abs(d - before) < 1e-5 * a:
            break
    return d


@inner_kernel
def start(
    solid: SolidFit | None,
    state: EstimatorState,
    frame: Pointer,
    scratch: Pointer,
    indices: IntArray | None,
) -> None:
    """Estimate from the frame alone: its strongest cells, then twice their moments."""
    m = state.moments
    signal = state.signal
    centres = further(scratch, state.at.centres)
    peak = signal.peak
    if peak > _WEAK * signal.noise:
        level = max(4.0 * signal.noise, 0.15 * peak)
        size = state.grid.rows * state.grid.cols
        sums_above(m, state.region, frame, centres, size, level)
        cells_factor = 1.0
    else:
        _sums_of_weak(state, frame, centres)
        cells_factor = 1.3  # of a weak contact's cells about three quarters pass
    if not m.total > 0.0:
        at = signal.row * state.grid.cols + signal.col
        size = state.grid.rows * state.grid.cols
        m.total, m.x, m.y, m.number = 1.0, centres[X * size + at], centres[Y * size + at], 1.0
    _set_from_area(m, state.grid, cells_factor * m.number)
    _refine(state, frame, centres)
    _refine(state, frame, centres)
    estimate = state.estimate
    estimate.d = m.d
    estimate.n_x = m.n_x
    estimate.n_y = m.n_y
    estimate.gain = min(max(m.gain, 0.02), 50.0)


@inner_kernel
def _sums_of_weak(state: EstimatorState, frame: Pointer, centres: Pointer) -> None:
    """Sum as :func:`sums_above` does, over weak pressures of a few times the noise.

    Lone cells mislead there: the sums are over cells of twice the noise whose neighbourhood stands
    out as a contact's.
    """
    m = state.moments
    level = 2.0 * state.signal.noise
    patch = state.options.patch_level * state.signal.noise
    size = state.grid.rows * state.grid.cols
    last = state.region.last
    total = sum_x = sum_y = number = 0.0
    at = next_above(frame, centres, state.region.first, last, level)
    while at < last:
        if neighbourhood(frame, centres, state.grid, at) > patch:
            value = frame[at]
            total += value
            sum_x += value * centres[X * size + at]
            sum_y += value * centres[Y * size + at]
            number += 1.0
        at = next_above(frame, centres, at + 1, last, level)
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.number = number


@inner_kernel
def _set_from_area(m: Moments, grid: Grid, number: float) -> None:
    """(d, n_x, n_y) of a contact of ``number`` cells about the centroid of the sums."""
    a = grid.radius
    # The footprint's area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * grid.pitch_x * grid.pitch_y / math.pi, 0.75 * a * a)
    d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    m.d = d
    _set_normal(m, m.x / m.total / (a - d / 3.0), m.y / m.total / (a - d / 3.0))


@inner_kernel
def _set_normal(m: Moments, n_x: float, n_y: float) -> None:
    """Take (n_x, n_y) shortened to at most 0.95."""
    length = math.hypot(n_x, n_y)
    if length > 0.95:
        n_x = 0.95 * n_x / length
        n_y = 0.95 * n_y / length
    m.n_x = n_x
    m.n_y = n_y


@inner_kernel
def _refine(state: EstimatorState, frame: Pointer, centres: Pointer) -> None:
    """Refine the contact in ``state.moments`` by the moments over its footprint, a cell wider.

    Where the gain is fixed the displacement comes from the force, otherwise from the extent, and
    the gain from the force; 0 where nothing presses.
    """
    m = state.moments
    grid = state.grid
    a = grid.radius
    blur = state.options.blur
    margin = _MARGIN * math.hypot(grid.pitch_x, grid.pitch_y) + _BLUR_MARGIN * blur
    rho = min(math.sqrt(max(m.d * (2.0 * a - m.d), 0.0)) + margin, 0.99 * a)
    set_face(m.face, a, a - math.sqrt(a * a - rho * rho), m.n_x, m.n_y)
    # Besides the blur, a point spreads over its cell.
    own = (grid.pitch_x * grid.pitch_x + grid.pitch_y * grid.pitch_y) / 12.0 + 2.0 * blur * blur
    footprint_moments(state, frame, centres, own)
    m.gain = 0.0
    if m.total > 0.0:
        _set_contact(state)


@inner_kernel
def _set_contact(state: EstimatorState) -> None:
    """Set :func:`_refine`'s contact from the moments."""
    m = state.moments
    grid = state.grid
    a = grid.radius
    modulus = state.options.modulus / state.signal.scale
    force = m.total * grid.pitch_x * grid.pitch_y
    d = m.d
    if state.options.free_gain:
        d = max(_d_from_extent(m, a, math.hypot(m.x, m.y)), 1e-4 * a)
    else:
        m.gain = 1.0
        cosine = math.sqrt(1.0 - m.n_x * m.n_x - m.n_y * m.n_y)
        plain = force * cosine / (math.pi * modulus)
        for _ in range(4):
            d = math.sqrt(plain / _ratio(m, a, d, 0))
            d = min(max(d, 1e-4 * a), 0.95 * a)
    m.d = d
    distance = _ratio(m, a, d, 1) * (a - d / 3.0)
    _set_normal(m, m.x / distance, m.y / distance)
    if state.options.free_gain:
        cosine = math.sqrt(1.0 - m.n_x * m.n_x - m.n_y * m.n_y)
        m.gain = force * cosine / (math.pi * modulus * d * d * _ratio(m, a, d, 0))
