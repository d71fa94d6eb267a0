"""Error budget: propagate errors other than white cell noise into the covariance of an estimate.

White noise of variance σ² gives the covariance σ² (JᵀJ)⁻¹, where J is the Jacobian of the fit.
Errors other than white noise are propagated linearly:

    shared error q     m mᵀ,   m = size (JᵀJ)⁻¹ Jᵀq                        (`set_shared_errors`)
      residuals        Σ size² qᵀq − m·(size Jᵀq)
    smooth error       W (JᵀJ)⁻¹ W smooth² Σ p², p the modelled pressures        (likewise)
    rotation           (n × z) rotation                                          (likewise)
    solid tip data     n tilt_error d/a                                          (likewise)
    correlated noise   standard deviations times √(C_ii/(JᵀJ)⁻¹_ii),
                       C = (JᵀJ)⁻¹ JᵀRJ (JᵀJ)⁻¹, at zero tilt         (`widen_covariance`)
    smooth misfit      Σ r_k r_(k−1) − n ρ₁ σ² − decrement                 (`undetected_misfit`)

The patterns q describe errors that are the same in every frame: a shift of all cells, its slopes in
x and y, the tip centre in x and y, the pitch, and the modulus or gain. ``size`` is the standard
deviation of each error. Patterns that move the tip relative to the cells are computed from pressure
differences between neighbouring cells.

R is the noise correlation as a function of the lag; it is measured by `calibrate`. The widening due
to R depends on the footprint size and is tabulated. W² contains the fractions of a smooth error's
energy that appear as a change in d and gain, and as a tilt. The fractions are small because the
errors of real cells are nearly as symmetric as the pressure. r_k are the residuals. For independent
noise, the products of neighbouring residuals average to zero, whereas a misfit that is smooth over
the footprint contributes fully to the sum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.state import (
    DEPTH,
    DEPTHS,
    GAIN,
    PARAMETERS,
    PLACE_X,
    PLACE_Y,
    PRESSURE,
    SCALING,
    SHIFT,
    SLOPE_X,
    SLOPE_Y,
    SOURCES,
    TILT_X,
    TILT_Y,
    Cells,
    EstimatorState,
)
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

__all__ = ["Uncertainty"]

NEIGHBOURS = np.outer((1.0, 2.0, 2.0, 2.0, 1.0), (1.0, 2.0, 2.0, 2.0, 1.0))  # see `detection`
NEIGHBOURS[2, 2] = 0.0
_NOISE_PEAK = 4.5  # maximum reading that noise alone causes, in standard deviations
_CELL_COUNT_MIN = 48.0  # minimum number of cells for separating smooth and rough misfits
# Fractions of a smooth error's energy that appear in d (and in the gain), in each tilt, and in the
# residuals. Curve errors, hysteresis and crosstalk are nearly as symmetric as the pressure.
_SMOOTH_IN_DEPTH, _SMOOTH_IN_TILT, _SMOOTH_IN_RESIDUALS = 0.15, 0.06, 0.2
# Relative tilt error of the solid model per d/a, found by comparison with frames from independent
# finite elements up to 20° and 7 mm. In this range, the error is 4 % for a bonded tip and
# negligible for a lying tip.
_SOLID_TILT_ERROR = 0.1
# Threshold for products of neighbouring residuals, in noise standard deviations.
_PRODUCT_SIGMA = 6.0


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of the sensor's common errors, and its noise correlation.

    Parameters
    ----------
    baseline
        Common shift of all cells [Pa].
    centre
        Position error of the tip on the sensor, in x and in y [m].
    pitch, modulus, gain
        Relative errors of the cell pitch, the tip's modulus and the common gain of all cells.
    correlation
        Noise correlation of two cells by their distance in rows and columns, [rows, cols], with 1
        at [0, 0]. The correlation is 0 at larger distances. None means white noise.
    slope
        Change of the zero offset from the tip centre to its rim, in x and in y [Pa].
    smooth
        Relative pressure error that neighbouring cells share, due to curve errors, hysteresis or
        crosstalk.
    rotation
        Rotation error of the sensor [rad].

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    baseline: float = 0.0
    centre: float = 0.0
    pitch: float = 0.0
    modulus: float = 0.0
    correlation: FloatArray | None = None
    slope: float = 0.0
    gain: float = 0.0
    smooth: float = 0.0
    rotation: float = 0.0

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self) if each.name != "correlation"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.correlation is not None:
            rho = np.asarray(self.correlation, np.float64)
            if rho.ndim != 2 or not np.isfinite(rho).all() or not abs(rho[0, 0] - 1.0) < 1e-6:
                raise ValueError(
                    "correlation must have shape [rows, cols] and the value 1 at [0, 0]"
                )
            object.__setattr__(self, "correlation", rho)


def set_budget(
    state: EstimatorState,
    known: Uncertainty,
    grid: SensorGrid,
    tip: Fingertip,
    material: Material,
    pattern: FloatArray | None,
) -> None:
    """Set the error budget, and raise the threshold of the activity test above the common errors.

    The material's ``fit_error`` [Pa], the maximum difference between the law and the fitted points,
    acts like a zero shift of the pressed cells. ``pattern`` [rows, cols] is the pattern used to
    detect the contact of a solid tip.
    """
    budget, options = state.budget, state.options
    modulus = 0.0 if options.free_gain else math.hypot(known.modulus, known.gain)
    budget.sizes[[SHIFT, SLOPE_X, SLOPE_Y]] = known.baseline, known.slope, known.slope
    budget.sizes[[PLACE_X, PLACE_Y, SCALING]] = known.centre, known.centre, known.pitch
    budget.sizes[SHIFT] = math.hypot(known.baseline, material.fit_error)
    budget.sizes[PRESSURE] = modulus
    budget.baseline, budget.slope = known.baseline, known.slope
    budget.smooth, budget.rotation = known.smooth, known.rotation
    budget.tilt_error = _SOLID_TILT_ERROR if options.is_solid else 0.0
    budget.has_common_errors = (
        max(*budget.sizes, budget.smooth, budget.rotation, budget.tilt_error) > 0.0
    )
    budget.cells_per_sample = 1.0
    level, weights = options.patch_level, NEIGHBOURS if pattern is None else pattern
    norm = float(np.sqrt((weights**2).sum()))
    if known.correlation is not None and known.correlation.size > 1:
        rho = mirrored(known.correlation)
        budget.is_correlated = True
        budget.cells_per_sample = float((rho**2).sum())
        if known.correlation.shape[1] > 1:
            budget.row_correlation = float(known.correlation[0, 1])
        _set_widening(state, rho, grid, tip, material)
        with_centre = float((weights * _cropped(rho, 5)).sum()) if pattern is None else 0.0
        variance = float(quadratic(weights, rho)) - with_centre**2
        level = (level * math.sqrt(max(variance, 0.0)) + _NOISE_PEAK * max(with_centre, 0.0)) / norm
    # A zero shift of twice the standard deviation ``baseline`` must not be detected as a contact.
    shift = 2.0 * known.baseline / options.noise * weights.sum() / norm
    options.patch_level = level + max(shift, 0.0)


def mirrored(correlation: FloatArray | None) -> FloatArray:
    """Extend a correlation to positive and negative lags, [2 rows − 1, 2 cols − 1]."""
    assert correlation is not None
    rows, cols = correlation.shape
    return np.asarray(
        correlation[np.abs(np.arange(1 - rows, rows))][:, np.abs(np.arange(1 - cols, cols))]
    )


def _cropped(rho: FloatArray, size: int) -> FloatArray:
    """Return the central part [size, size] of ``rho``, padded with zeros."""
    out = np.zeros((size, size))
    for i in range(size):
        for j in range(size):
            at = i - size // 2 + rho.shape[0] // 2, j - size // 2 + rho.shape[1] // 2
            if 0 <= at[0] < rho.shape[0] and 0 <= at[1] < rho.shape[1]:
                out[i, j] = rho[at]
    return out


def quadratic(fields: FloatArray, rho: FloatArray) -> FloatArray:
    """Return Σ field · ρ · field over pairs of cells, for fields [rows, cols] or […, n]."""
    several = fields.reshape(*fields.shape[:2], -1)
    shape = [n + m for n, m in zip(fields.shape[:2], rho.shape, strict=True)]
    kernel = np.zeros(shape)
    kernel[: rho.shape[0], : rho.shape[1]] = rho
    kernel = np.roll(kernel, (-(rho.shape[0] // 2), -(rho.shape[1] // 2)), (0, 1))
    # A measured correlation may imply negative power at some frequencies, so clip the power at
    # zero.
    power = np.maximum(np.fft.fft2(kernel).real, 0.0)
    waves = np.fft.fft2(several, shape, axes=(0, 1))
    out = np.einsum("xyi,xy,xyj->ij", waves.conj(), power, waves).real / power.size
    return np.asarray(out if fields.ndim == 3 else out[0, 0])


def _set_widening(
    state: EstimatorState, rho: FloatArray, grid: SensorGrid, tip: Fingertip, material: Material
) -> None:
    """Tabulate the widening by correlated noise at zero tilt, and the fit's degrees of freedom."""
    options = state.options
    first = 0 if options.free_gain else 1
    for k in range(DEPTHS):
        d = options.deepest * ((k + 1) / DEPTHS) ** 2

        def at(d: float, x: float = 0.0, y: float = 0.0) -> FloatArray:
            return grid.pressure(tip, material, d, x, y)

        step = 1e-3
        less = d * (1.0 - step)
        columns = [
            at(d),
            (at(d) - at(less)) / (d - less),
            (at(d, step) - at(d, -step)) / (2.0 * step),
            (at(d, 0.0, step) - at(d, 0.0, -step)) / (2.0 * step),
        ]
        jacobian = np.stack(columns[first:], axis=2)
        jacobian /= np.sqrt((jacobian**2).sum(axis=(0, 1)))
        white = np.linalg.inv(np.einsum("xyi,xyj->ij", jacobian, jacobian))
        correlated = white @ quadratic(jacobian, rho)
        state.budget.widening[k, 4] = np.trace(correlated)
        wider = np.sqrt(np.diag(correlated @ white) / np.diag(white))
        state.budget.widening[k, first:4] = wider


@inner_kernel
def widen_covariance(state: EstimatorState) -> float:
    """Widen ``fit.inverse`` for correlated noise; return the degrees of freedom used by the fit."""
    inverse = state.fit.inverse
    table = state.budget.widening
    t = DEPTHS * math.sqrt(state.fit.d / state.options.deepest) - 1.0
    t = min(max(t, 0.0), DEPTHS - 1.001)
    k = int(t)
    t -= k
    for i in range(4):
        factor = (1.0 - t) * table[k, i] + t * table[k + 1, i]
        for j in range(PARAMETERS):
            inverse[i, j] *= factor
            inverse[j, i] *= factor
    lost: float = (1.0 - t) * table[k, 4] + t * table[k + 1, 4]
    return lost


@fast_inner_kernel
def _neighbours_products(cells: Cells, lowest: float, first: int, last: int) -> tuple[float, float]:
    """Return the sum [Pa²] and the number of products of neighbouring residuals in a row.

    Only cells with a modelled pressure above ``lowest`` [Pa] are included.
    """
    total = 0.0
    number = 0.0
    one = index(1)
    for k in range(first + one, last):
        before = k - one
        both = (cells.factor[k] > 0.0) & (cells.factor[before] > 0.0)
        both &= min(cells.model[k], cells.model[before]) > lowest
        total += cells.residual[k] * cells.residual[before] if both else 0.0
        number += 1.0 if both else 0.0
    return total, number


@inner_kernel
def undetected_misfit(state: EstimatorState, cells: Cells, beyond: float) -> float:
    """Return the part of the squared misfit [Pa²] that is smooth over the footprint.

    The result is 0 if noise explains the misfit. ``beyond`` [Pa²] is the excess of the total misfit
    over its expected value. If the footprint has only a few cells, the smooth part cannot be
    separated; in this case, the whole excess is returned.
    """
    fit = state.fit
    variance = state.signal.variance
    cols = state.grid.cols
    # Near the floor, clipping raises the mean reading above the pressure.
    lowest = max(state.signal.floor, 0.0) + 2.0 * fit.clip_noise
    total, number = _neighbours_products(
        cells, lowest, index(fit.first_row * cols), index(fit.last_row * cols)
    )
    # The residuals do not yet include the decrement of the last step.
    total -= number * variance * state.budget.row_correlation + fit.decrement
    total = beyond if number < _CELL_COUNT_MIN else min(total, beyond)
    if total <= _PRODUCT_SIGMA * variance * math.sqrt(number * state.budget.cells_per_sample):
        return 0.0
    return total


@fast_inner_kernel
def _project(
    state: EstimatorState, cells: Cells, column: int, values: FloatArray, first: int, last: int
) -> None:
    """Set Jᵀq of one Jacobian column, and qᵀq, for all patterns except the pressure."""
    one = index(1)
    two = index(2)
    cols = index(state.grid.cols)
    both = cols + cols
    per_x = 1.0 / (12.0 * state.grid.pitch_x)
    per_y = 1.0 / (12.0 * state.grid.pitch_y)
    per_radius = 1.0 / state.grid.radius
    end = index(cells.stress.shape[0]) - both
    p = cells.stress
    q0 = q1 = q2 = q3 = q4 = q5 = n0 = n1 = n2 = n3 = n4 = n5 = 0.0
    for k in range(max(first, both), min(last, end)):
        counts = cells.factor[k] > 0.0
        own = cells.factor[k] * values[k]
        x = cells.x[k] if counts else 0.0
        y = cells.y[k] if counts else 0.0
        by_x = per_x * (8.0 * (p[k + one] - p[k - one]) - p[k + two] + p[k - two])
        by_y = per_y * (8.0 * (p[k + cols] - p[k - cols]) - p[k + both] + p[k - both])
        by_x = by_x if counts else 0.0
        by_y = by_y if counts else 0.0
        by_pitch = x * by_x + y * by_y
        q0 += own
        q1 += own * x
        q2 += own * y
        q3 += own * by_x
        q4 += own * by_y
        q5 += own * by_pitch
        n0 += 1.0 if counts else 0.0
        n1 += x * x
        n2 += y * y
        n3 += by_x * by_x
        n4 += by_y * by_y
        n5 += by_pitch * by_pitch
    responses = state.budget.responses
    squares = state.budget.squares
    responses[column, SHIFT], squares[SHIFT] = q0, n0
    responses[column, SLOPE_X], squares[SLOPE_X] = per_radius * q1, per_radius * per_radius * n1
    responses[column, SLOPE_Y], squares[SLOPE_Y] = per_radius * q2, per_radius * per_radius * n2
    responses[column, PLACE_X], squares[PLACE_X] = q3, n3
    responses[column, PLACE_Y], squares[PLACE_Y] = q4, n4
    responses[column, SCALING], squares[SCALING] = q5, n5


@inner_kernel
def set_shared_errors(state: EstimatorState, cells: Cells) -> float:
    """Set ``budget.shared``, the covariance of the fit parameters due to common errors.

    ``fit.inverse`` must be the covariance for white noise of variance 1 Pa². Returns the sum of
    squared residuals [Pa²] that results if each common error equals twice its standard deviation.
    """
    fit = state.fit
    budget = state.budget
    shared = budget.shared
    inverse = fit.inverse
    gain = fit.gain
    first = index(fit.first_row * state.grid.cols)
    last = index(fit.last_row * state.grid.cols)
    _project(state, cells, GAIN, cells.stress, first, last)
    _project(state, cells, DEPTH, cells.by_d, first, last)
    _project(state, cells, TILT_X, cells.by_x, first, last)
    _project(state, cells, TILT_Y, cells.by_y, first, last)
    pressure: float = fit.normal[GAIN, GAIN]
    budget.squares[PRESSURE] = pressure
    for i in range(PARAMETERS):
        factor = gain if i > GAIN else 1.0
        for source in range(PRESSURE):
            budget.responses[i, source] *= factor
        budget.responses[i, PRESSURE] = fit.normal[i, GAIN]
    smooth = budget.smooth * budget.smooth * gain * gain * pressure
    deep = math.sqrt(_SMOOTH_IN_DEPTH * smooth)
    tilted = math.sqrt(_SMOOTH_IN_TILT * smooth)
    parts = (deep, deep, tilted, tilted)
    for i in range(4):
        for j in range(4):
            shared[i, j] = parts[i] * parts[j] * inverse[i, j]
    remaining = _SMOOTH_IN_RESIDUALS * smooth
    displacement = budget.displacement
    for source in range(SOURCES):
        size = budget.sizes[source]
        if size == 0.0:
            continue
        # Patterns that shift or scale the pressure image are proportional to the gain, but offsets
        # are not.
        size *= gain if source >= PLACE_X else 1.0
        remaining += size * size * budget.squares[source]
        for i in range(PARAMETERS):
            displacement[i] = 0.0
            for j in range(PARAMETERS):
                displacement[i] += inverse[i, j] * budget.responses[j, source] * size
        for i in range(PARAMETERS):
            remaining -= displacement[i] * budget.responses[i, source] * size
            for j in range(PARAMETERS):
                shared[i, j] += displacement[i] * displacement[j]
    along = budget.tilt_error * fit.d / state.grid.radius
    for i in range(2):
        for j in range(2):
            # Split the pattern into components along and across the tilt direction.
            n_i = fit.n_y if i else fit.n_x
            n_j = fit.n_y if j else fit.n_x
            m_i = fit.n_x if i else -fit.n_y
            m_j = fit.n_x if j else -fit.n_y
            more = along * along * n_i * n_j + budget.rotation * budget.rotation * m_i * m_j
            shared[TILT_X + i, TILT_X + j] += more
    return 4.0 * max(remaining, 0.0)
