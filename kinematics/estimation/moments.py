"""Kernels for the initial contact estimate from the sum, centroid and extent of a frame.

The pressure moments over the footprint are compared with the model's moments, which are tabulated
versus d. The force or the extent determines d, and the centroid determines the tilt.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.cell_centres import next_above, sums_above, sums_inside
from softfinger.kinematics.estimation.detection import neighbourhood
from softfinger.kinematics.estimation.state import START_POINTS, Cells, EstimatorState, Moments
from softfinger.kinematics.sensing.footprint import FloatArray, Grid, set_around, set_face
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

# Margin around the footprint, in cell diagonals. All cells that touch the footprint have their
# centres within this margin, even after a small motion of the contact.
_MARGIN = 0.75
_BLUR_MARGIN = 2.0  # additional margin around the footprint, in standard deviations of the blur
# Tilt at which the centroid's moment arm is computed [rad]. The arm hardly depends on the tilt.
_TILT = 0.2
_WEAK_PEAK = 15.0  # peak below which neighbourhoods are used, in noise standard deviations
_SINE_MAX = 0.95
_NO_LEVEL = -1e300  # threshold that is below every reading


def tabulate_moments(
    m: Moments, grid: SensorGrid, tip: Fingertip, material: Material, deepest: float
) -> None:
    """Tabulate the moments of the model for d up to ``deepest`` [m]."""
    cells = grid.on(tip)
    x = (cells.x + cells.pitch_x * (np.arange(cells.cols) + 0.5))[None, :]
    y = (cells.y + cells.pitch_y * (np.arange(cells.rows) + 0.5))[:, None]
    for k in range(1, START_POINTS):
        d = deepest * (k / (START_POINTS - 1)) ** 2
        straight, tilted = (grid.pressure(tip, material, d, tilt) for tilt in (0.0, _TILT))
        m.force[k] = total = max(float(straight.sum()), 1e-9)
        square = float((straight * (x * x + y * y)).sum()) / total
        middle = [float((straight * at).sum()) / total for at in (x, y)]
        m.extent[k] = square - middle[0] ** 2 - middle[1] ** 2
        n_x, n_y = grid.to_sensor(math.sin(_TILT), 0.0)
        moved = [float((tilted * at).sum() / max(float(tilted.sum()), 1e-9)) for at in (x, y)]
        m.centroid_arm[k] = (moved[0] * n_x + moved[1] * n_y) / (n_x * n_x + n_y * n_y)
    m.centroid_arm[0] = m.centroid_arm[1]
    m.centroid_arm[:] = np.maximum(m.centroid_arm, 0.1 * tip.radius)


@inner_kernel
def _interpolate(values: FloatArray, t: float) -> float:
    """Interpolate a table at position t."""
    k = min(int(t), START_POINTS - 2)
    return float(values[k] + (t - k) * (values[k + 1] - values[k]))


@inner_kernel
def _inverse(values: FloatArray, value: float) -> float:
    """Return the position of ``value`` in an increasing table, clamped to the ends of the table."""
    for k in range(START_POINTS - 1):
        if value < values[k + 1]:
            rise = values[k + 1] - values[k]
            return k + min(max((value - values[k]) / rise, 0.0), 1.0) if rise > 0.0 else float(k)
    return START_POINTS - 1.0


@inner_kernel
def start(state: EstimatorState, frame: FloatArray, cells: Cells) -> None:
    """Estimate the contact from the frame alone: once from strong cells, twice from moments."""
    m = state.moments
    signal = state.signal
    estimate = state.estimate
    if state.options.is_solid:
        # A solid tip loads its whole base, and the extent of the pressure hardly depends on d.
        sums_above(m, frame, cells, _NO_LEVEL)
        m.gain = 1.0
        if m.total > 0.0:
            m.x /= m.total
            m.y /= m.total
        _set_contact(state, False)
    else:
        weak = signal.peak <= _WEAK_PEAK * signal.noise
        if weak:
            _sums_of_weak(state, frame, cells)
        else:
            sums_above(m, frame, cells, max(4.0 * signal.noise, 0.15 * signal.peak))
        if not m.total > 0.0:
            at = signal.row * state.grid.cols + signal.col
            m.total, m.x, m.y, m.number = 1.0, cells.x[at], cells.y[at], 1.0
        # In a weak contact, about three quarters of the cells exceed the threshold.
        _set_from_area(m, state.grid, 1.3 * m.number if weak else m.number)
        _refine(state, frame, cells)
        _refine(state, frame, cells)
    estimate.d = m.d
    estimate.n_x = m.n_x
    estimate.n_y = m.n_y
    estimate.gain = min(max(m.gain, 0.02), 50.0)
    estimate.shear[:] = 0.0


@inner_kernel
def _sums_of_weak(state: EstimatorState, frame: FloatArray, cells: Cells) -> None:
    """Compute the same sums as :func:`sums_above` for pressures of a few times the noise.

    Single noisy cells would distort the sums. The sums therefore include only cells that read at
    least twice the noise and have a significant neighbourhood.
    """
    m = state.moments
    level = 2.0 * state.signal.noise
    patch = state.options.patch_level * state.signal.noise
    last = frame.shape[0]
    total = sum_x = sum_y = number = 0.0
    at = next_above(frame, cells.height, 0, last, level)
    while at < last:
        if neighbourhood(frame, cells.height, state.grid, at) > patch:
            total += frame[at]
            sum_x += frame[at] * cells.x[at]
            sum_y += frame[at] * cells.y[at]
            number += 1.0
        at = next_above(frame, cells.height, at + 1, last, level)
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.number = number


@inner_kernel
def _set_from_area(m: Moments, grid: Grid, number: float) -> None:
    """Set (d, n_x, n_y) for a contact of ``number`` cells around the centroid of the sums."""
    a = grid.radius
    # The footprint area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * grid.pitch_x * grid.pitch_y / math.pi, 0.75 * a * a)
    m.d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    distance = m.total * (a - m.d / 3.0)
    _set_normal(m, m.x / distance, m.y / distance)


@inner_kernel
def _set_normal(m: Moments, n_x: float, n_y: float) -> None:
    """Set (n_x, n_y), shortened if it is too long for a unit normal."""
    shorter = min(1.0, _SINE_MAX / max(math.hypot(n_x, n_y), 1e-9))
    m.n_x = shorter * n_x
    m.n_y = shorter * n_y


@inner_kernel
def _refine(state: EstimatorState, frame: FloatArray, cells: Cells) -> None:
    """Refine the contact in ``state.moments`` using the moments over the widened footprint."""
    m = state.moments
    grid = state.grid
    face = state.around
    a = grid.radius
    margin = _MARGIN * math.hypot(grid.pitch_x, grid.pitch_y) + _BLUR_MARGIN * state.options.blur
    set_face(face, a, m.d, m.n_x, m.n_y)
    set_around(face, face, a, margin)
    sums_inside(m, frame, cells, face.u, face.v, face.w)
    m.gain = 0.0
    if m.total > 0.0:
        m.x /= m.total
        m.y /= m.total
        m.trace = m.trace / m.total - m.x * m.x - m.y * m.y
        _set_contact(state, state.options.free_gain)


@inner_kernel
def _set_contact(state: EstimatorState, by_extent: bool) -> None:
    """Set the contact from the moments.

    If ``by_extent`` is True, the extent determines d and the force determines the gain. Otherwise
    the force determines d.
    """
    m = state.moments
    force = m.total * state.signal.scale
    t = _inverse(m.extent, m.trace) if by_extent else _inverse(m.force, force)
    t = max(t, 0.25)
    m.d = state.options.deepest * (t / (START_POINTS - 1)) ** 2
    m.gain = force / _interpolate(m.force, t) if by_extent else 1.0
    centroid_arm = _interpolate(m.centroid_arm, t)
    _set_normal(m, m.x / centroid_arm, m.y / centroid_arm)
