"""Kernels for the initial contact estimate from the sum, centroid and extent of a frame.

The pressure moments over the footprint are compared with the model's moments, which are tabulated
as a function of d. The force or the extent determines d, and the centroid determines the tilt.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.detection import neighbourhood, next_above
from softfinger.kinematics.estimation.state import (
    DEPTH,
    GAIN,
    START_POINTS,
    TILT_X,
    TILT_Y,
    Cells,
    EstimatorState,
    Moments,
)
from softfinger.kinematics.sensing.footprint import axes, set_around, set_face
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

# Margin around the footprint, in cell diagonals. This margin includes the centres of all cells that
# touch the footprint, even after a small motion.
_MARGIN = 0.75
_BLUR_MARGIN = 2.0  # additional margin around the footprint, in standard deviations of the blur
# Tilt at which the centroid's moment arm is computed [rad]. The moment arm is nearly independent of
# tilt.
_TILT = 0.2
_WEAK_PEAK = 15.0  # maximum peak for using neighbourhood sums, in noise standard deviations
_SINE_MAX = 0.95


def tabulate_moments(
    m: Moments, grid: SensorGrid, tip: Fingertip, material: Material, deepest: float
) -> None:
    """Tabulate the moments of the model for d up to ``deepest`` [m]."""
    cells = grid.on(tip)
    x, y = np.meshgrid(*axes(cells))
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
    """Estimate the contact from one frame: first from strong cells, then twice from the moments."""
    m = state.moments
    signal = state.signal
    guess = state.estimate.guess
    guess[:] = 0.0
    if state.options.is_solid:
        # A solid tip loads its whole base, and the width of the pressure distribution is nearly
        # independent of d.
        _select_inside(cells, 0.0, 0.0, 0.0)
        _set_moments(m, frame, cells)
        _set_contact(state)
    else:
        weak = signal.peak <= _WEAK_PEAK * signal.noise
        if weak:
            _select_weak(state, frame, cells)
        else:
            _select_above(frame, cells, max(4.0 * signal.noise, 0.15 * signal.peak))
        _set_moments(m, frame, cells)
        if not m.total > 0.0:
            at = signal.cell
            m.x, m.y, m.number = cells.x[at], cells.y[at], 1.0
        # In a weak contact, about three quarters of the pressed cells exceed the threshold.
        _set_from_area(state, 1.3 * m.number if weak else m.number)
        _refine(state, frame, cells)
        _refine(state, frame, cells)
    guess[GAIN] = min(max(guess[GAIN], 0.02), 50.0)


@fast_inner_kernel
def _set_moments(m: Moments, frame: FloatArray, cells: Cells) -> None:
    """Compute the moments of the frame over the cells with a nonzero ``factor``."""
    total = sum_x = sum_y = square = number = 0.0
    for k in range(index(0), index(frame.shape[0])):
        counts = cells.factor[k] != 0.0
        x = cells.x[k]
        y = cells.y[k]
        value = frame[k] if counts else 0.0
        total += value
        sum_x += value * x
        sum_y += value * y
        square += value * (x * x + y * y)
        number += 1.0 if counts else 0.0
    each = 1.0 / total if total > 0.0 else 0.0
    m.total = total
    m.x = each * sum_x
    m.y = each * sum_y
    m.trace = each * square - m.x * m.x - m.y * m.y
    m.number = number


@fast_inner_kernel
def _select_above(frame: FloatArray, cells: Cells, level: float) -> None:
    """Select the cells that read more than ``level``."""
    for k in range(index(0), index(frame.shape[0])):
        cells.factor[k] = 1.0 if (cells.height[k] >= 0.0) & (frame[k] > level) else 0.0


@fast_inner_kernel
def _select_inside(cells: Cells, u: float, v: float, w: float) -> None:
    """Select the cells whose centre is pressed by the face."""
    for k in range(index(0), index(cells.height.shape[0])):
        inside = cells.height[k] > u - v * cells.x[k] - w * cells.y[k]
        cells.factor[k] = 1.0 if inside else 0.0


@inner_kernel
def _select_weak(state: EstimatorState, frame: FloatArray, cells: Cells) -> None:
    """Select the cells of a weak contact, whose pressures are only a few times the noise.

    Single noisy cells would distort the moments. A selected cell must therefore read at least twice
    the noise, and the sum of its neighbours must be significant.
    """
    level = 2.0 * state.signal.noise
    patch = state.options.patch_level * state.signal.noise
    last = frame.shape[0]
    cells.factor[:] = 0.0
    at = next_above(frame, cells.height, 0, last, level)
    while at < last:
        if neighbourhood(frame, cells.height, state.grid, at) > patch:
            cells.factor[at] = 1.0
        at = next_above(frame, cells.height, at + 1, last, level)


@inner_kernel
def _set_from_area(state: EstimatorState, number: float) -> None:
    """Set the guess for a contact with an area of ``number`` cells around the centroid."""
    grid = state.grid
    a = grid.radius
    # The footprint area is π ρ² cos θ with ρ² = 2 a d − d².
    rho2 = min(number * grid.pitch_x * grid.pitch_y / math.pi, 0.75 * a * a)
    d = max(a - math.sqrt(a * a - rho2), 1e-3 * a)
    state.estimate.guess[DEPTH] = d
    _set_normal(state, a - d / 3.0)


@inner_kernel
def _set_normal(state: EstimatorState, arm: float) -> None:
    """Set the normal from the centroid; limit the normal's in-plane part to `_SINE_MAX`."""
    guess = state.estimate.guess
    n_x, n_y = state.moments.x / arm, state.moments.y / arm
    shorter = min(1.0, _SINE_MAX / max(math.hypot(n_x, n_y), 1e-9))
    guess[TILT_X] = shorter * n_x
    guess[TILT_Y] = shorter * n_y


@inner_kernel
def _refine(state: EstimatorState, frame: FloatArray, cells: Cells) -> None:
    """Refine the guess, using the moments over the widened footprint of the last guess."""
    guess = state.estimate.guess
    grid = state.grid
    face = state.around
    a = grid.radius
    margin = _MARGIN * math.hypot(grid.pitch_x, grid.pitch_y) + _BLUR_MARGIN * state.options.blur
    set_face(face, a, guess[DEPTH], guess[TILT_X], guess[TILT_Y])
    set_around(face, face, a, margin)
    _select_inside(cells, face.u, face.v, face.w)
    _set_moments(state.moments, frame, cells)
    guess[GAIN] = 0.0
    if state.moments.total > 0.0:
        _set_contact(state)


@inner_kernel
def _set_contact(state: EstimatorState) -> None:
    """Set the guess from the moments.

    If a spring tip's gain is free, the extent determines d and the force determines the gain.
    Otherwise, the force determines d.
    """
    m = state.moments
    guess = state.estimate.guess
    by_extent = state.options.free_gain and not state.options.is_solid
    force = m.total * state.signal.scale
    t = _inverse(m.extent, m.trace) if by_extent else _inverse(m.force, force)
    t = max(t, 0.25)
    guess[DEPTH] = state.options.deepest * (t / (START_POINTS - 1)) ** 2
    guess[GAIN] = force / _interpolate(m.force, t) if by_extent else 1.0
    _set_normal(state, _interpolate(m.centroid_arm, t))
