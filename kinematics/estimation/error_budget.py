"""Propagate errors other than white cell noise into the covariance of an estimate.

White noise of variance σ² results in the covariance σ² (JᵀJ)⁻¹, where J is the Jacobian of the fit.
Errors other than white noise are propagated linearly:

    shared error q     m mᵀ,   m = size (JᵀJ)⁻¹ Jᵀq                        (`set_shared_errors`)
      residuals        Σ size² qᵀq − m·(size Jᵀq)
    smooth error       W (JᵀJ)⁻¹ W smooth² Σ p², p the modelled pressures        (likewise)
    rotation           (n × z) rotation                                          (likewise)
    solid tip data     n tilt_error d/a                                          (likewise)
    correlated noise   standard deviations times √(C_ii/(JᵀJ)⁻¹_ii),
                       C = (JᵀJ)⁻¹ JᵀRJ (JᵀJ)⁻¹, at zero tilt         (`widen_covariance`)
    smooth misfit      Σ r_k r_(k−1) − n ρ₁ σ² − decrement                 (`undetected_misfit`)

Each pattern q describes an error that is the same in every frame. The zero offset has three errors:
a shift of all cells and slopes in x and y. The other errors affect the tip position in x and y, the
pitch, and the modulus or gain. ``size`` is the standard deviation of an error. The patterns for tip
position and pitch are computed from pressure differences between neighbouring cells.

R is the noise correlation that `calibrate` measures as a function of the distance between cells.
The factors by which R widens the covariance are tabulated as a function of d. W² contains the
fractions of a smooth error's energy that appear in d, in the gain and in the tilts. The fractions
are small, because the errors of real cells are nearly as symmetric as the pressure distribution.
The r_k are the residuals. For independent noise, the products of neighbouring residuals average to
zero. A misfit that is smooth over the footprint contributes fully to the sum of the products.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.state import (
    DEPTH,
    DEPTHS,
    GAIN,
    PARAMETERS,
    SOURCES,
    TILT_X,
    TILT_Y,
    Cells,
    EstimatorState,
)
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

__all__ = ["Uncertainty"]

NEIGHBOURS = 2  # number of neighbours on each side for the patterns of tip position and pitch
_NEIGHBOURS = np.outer((1.0, 2.0, 2.0, 2.0, 1.0), (1.0, 2.0, 2.0, 2.0, 1.0))  # see `detection`
_NEIGHBOURS[2, 2] = 0.0
_NOISE_PEAK = 4.5  # maximum reading due to noise alone, in standard deviations
_CELL_COUNT_MIN = 48.0  # minimum number of cells for separating smooth and rough misfits
# Fractions of a smooth error's energy that change d (and the gain), each tilt, and the residuals.
# Curve errors, hysteresis and crosstalk are nearly as symmetric as the pressure distribution.
_SMOOTH_IN_DEPTH, _SMOOTH_IN_TILT, _SMOOTH_IN_RESIDUALS = 0.15, 0.06, 0.2
# Relative tilt error of the solid model, divided by d/a. The model was compared with frames from
# independent finite-element models, for tilts up to 20° and displacements up to 7 mm. The relative
# tilt error was 4 % for a bonded tip, and negligible for a tip that lies on its sensor.
_SOLID_TILT_ERROR = 0.1
# Threshold for the sum of products of neighbouring residuals, in noise standard deviations.
_PRODUCT_SIGMA = 6.0


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of the errors that all frames share, and the noise correlation.

    Parameters
    ----------
    baseline
        Common shift of all cells [Pa].
    centre
        Position error of the tip on the sensor, in x and in y [m].
    pitch, modulus, gain
        Relative errors of the cell pitch, the tip's modulus and the common gain of all cells.
    correlation
        Noise correlation of two cells, indexed by their distance [rows, cols]. The value at [0, 0]
        is 1. At distances outside the array, the correlation is 0. None means white noise.
    slope
        Change of the zero offset [Pa] from the tip's centre to its rim, in x and in y.
    smooth
        Relative pressure error shared by neighbouring cells. The causes are curve errors,
        hysteresis and crosstalk.
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

    The material's ``fit_error`` [Pa] is the maximum difference between the material law and the
    fitted points. The error budget treats ``fit_error`` as a zero shift of the cells in contact.
    ``pattern`` [rows, cols] is used to detect contacts of a solid tip.
    """
    budget, options = state.budget, state.options
    modulus = 0.0 if options.free_gain else math.hypot(known.modulus, known.gain)
    shift = math.hypot(known.baseline, material.fit_error)
    budget.sizes[:] = (
        shift, known.slope, known.slope, known.centre, known.centre, known.pitch, modulus
    )  # fmt: skip
    budget.baseline, budget.slope = known.baseline, known.slope
    budget.smooth, budget.rotation = known.smooth, known.rotation
    budget.tilt_error = _SOLID_TILT_ERROR if options.is_solid else 0.0
    budget.has_common_errors = (
        max(*budget.sizes, budget.smooth, budget.rotation, budget.tilt_error) > 0.0
    )
    budget.cells_per_sample = 1.0
    level, weights = options.patch_level, _NEIGHBOURS if pattern is None else pattern
    norm = float(np.sqrt((weights**2).sum()))
    if known.correlation is not None and known.correlation.size > 1:
        rho = mirrored(known.correlation)
        budget.is_correlated = True
        budget.cells_per_sample = float((rho**2).sum())
        if known.correlation.shape[1] > 1:
            budget.row_correlation = float(known.correlation[0, 1])
        _set_widening(state, rho, grid, tip, material)
        centre = np.zeros(weights.shape)
        if pattern is None:
            centre[2, 2] = 1.0
        (variance, with_centre), _ = quadratic(np.stack([weights, centre], axis=2), rho)
        variance -= with_centre**2
        level = (level * math.sqrt(max(variance, 0.0)) + _NOISE_PEAK * max(with_centre, 0.0)) / norm
    # A zero shift of 2 · ``baseline`` must not be detected as a contact.
    shift = 2.0 * known.baseline / options.noise * weights.sum() / norm
    options.patch_level = level + max(shift, 0.0)


def mirrored(correlation: FloatArray) -> FloatArray:
    """Mirror a correlation to negative distances; the result has shape [2 rows − 1, 2 cols − 1]."""
    rows, cols = (np.abs(np.arange(1 - count, count)) for count in correlation.shape)
    return np.asarray(correlation[np.ix_(rows, cols)])


def quadratic(fields: FloatArray, rho: FloatArray) -> FloatArray:
    """Return the sums of field_i · ρ · field_j over all pairs of cells, [n, n].

    ``fields`` has shape [rows, cols, n].
    """
    shape = [n + m for n, m in zip(fields.shape[:2], rho.shape, strict=True)]
    kernel = np.zeros(shape)
    kernel[: rho.shape[0], : rho.shape[1]] = rho
    kernel = np.roll(kernel, (-(rho.shape[0] // 2), -(rho.shape[1] // 2)), (0, 1))
    # The spectrum of a measured correlation may be negative at some frequencies, so clip it at
    # zero.
    power = np.maximum(np.fft.fft2(kernel).real, 0.0)
    waves = np.fft.fft2(fields, shape, axes=(0, 1))
    return np.asarray(np.einsum("xyi,xy,xyj->ij", waves.conj(), power, waves).real / power.size)


def _set_widening(
    state: EstimatorState, rho: FloatArray, grid: SensorGrid, tip: Fingertip, material: Material
) -> None:
    """Tabulate how correlated noise changes the covariance and degrees of freedom at zero tilt."""
    options = state.options
    first = 0 if options.free_gain else 1
    step = 1e-3
    steps = (0, 0, 0), (-step, 0, 0), (0, step, 0), (0, -step, 0), (0, 0, step), (0, 0, -step)
    for k in range(DEPTHS):
        d = options.deepest * ((k + 1) / DEPTHS) ** 2
        frames = [grid.pressure(tip, material, d + d * by_d, x, y) for by_d, x, y in steps]
        columns = [frames[0], *(frames[j] - frames[j + 1] for j in (0, 2, 4))]
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
    t = DEPTHS * math.sqrt(state.fit.contact[DEPTH] / state.options.deepest) - 1.0
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
    """Sum the products of residuals that are adjacent in a grid row; return sum [Pa²] and count.

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
    over its expected value. If the footprint has too few cells to separate the smooth part, the
    result is the whole excess.
    """
    fit = state.fit
    variance = state.signal.variance
    # Exclude cells near the floor, where clipping raises the mean reading above the pressure.
    lowest = max(state.signal.floor, 0.0) + 2.0 * fit.clip_noise
    first, last = index(fit.first_cell), index(fit.last_cell)
    total, number = _neighbours_products(cells, lowest, first, last)
    # The residuals were computed before the last step, so subtract the predicted decrease.
    total -= number * variance * state.budget.row_correlation + fit.decrement
    total = beyond if number < _CELL_COUNT_MIN else min(total, beyond)
    if total <= _PRODUCT_SIGMA * variance * math.sqrt(number * state.budget.cells_per_sample):
        return 0.0
    return total


@fast_inner_kernel
def product(a: FloatArray, b: FloatArray, first: int, last: int) -> float:
    """Return the dot product of two rows over a range of cells."""
    total = 0.0
    for k in range(first, last):
        total += a[k] * b[k]
    return total


@fast_inner_kernel
def _set_errors(state: EstimatorState, cells: Cells, first: int, last: int) -> None:
    """Set the pattern of each common error, i.e. the change in the readings per unit error.

    The patterns are in the order of `Budget.sizes`. Patterns that use differences between
    neighbours are zero in the first two and last two rows.
    """
    one = index(1)
    two = index(2)
    cols = index(state.grid.cols)
    both = cols + cols
    gain = state.fit.contact[GAIN]
    per_x = gain / (12.0 * state.grid.pitch_x)
    per_y = gain / (12.0 * state.grid.pitch_y)
    per_radius = 1.0 / state.grid.radius
    p = cells.sensitivity[GAIN]
    errors = cells.errors
    for k in range(max(first, both), min(last, index(p.shape[0]) - both)):
        counts = 1.0 if cells.factor[k] > 0.0 else 0.0
        by_x = per_x * (8.0 * (p[k + one] - p[k - one]) - p[k + two] + p[k - two])
        by_y = per_y * (8.0 * (p[k + cols] - p[k - cols]) - p[k + both] + p[k - both])
        errors[3, k] = counts * by_x
        errors[4, k] = counts * by_y
        errors[5, k] = counts * (cells.x[k] * by_x + cells.y[k] * by_y)
    for k in range(first, last):
        counts = 1.0 if cells.factor[k] > 0.0 else 0.0
        errors[0, k] = counts
        errors[1, k] = counts * per_radius * cells.x[k]
        errors[2, k] = counts * per_radius * cells.y[k]
        errors[6, k] = gain * cells.jacobian[GAIN, k]


@inner_kernel
def set_shared_errors(state: EstimatorState, cells: Cells) -> float:
    """Set ``budget.shared``, the covariance of the fit parameters due to common errors.

    ``fit.inverse`` must be the covariance for white noise of variance 1 Pa². Returns the sum of
    squared residuals [Pa²] due to common errors of two standard deviations.
    """
    fit = state.fit
    budget = state.budget
    shared = budget.shared
    response = budget.response
    displacement = budget.displacement
    gain, d, n_x, n_y = (
        fit.contact[GAIN],
        fit.contact[DEPTH],
        fit.contact[TILT_X],
        fit.contact[TILT_Y],
    )
    first, last = index(fit.first_cell), index(fit.last_cell)
    _set_errors(state, cells, first, last)
    smooth = (budget.smooth * gain) ** 2 * fit.normal[GAIN, GAIN]
    deep = math.sqrt(_SMOOTH_IN_DEPTH * smooth)
    tilted = math.sqrt(_SMOOTH_IN_TILT * smooth)
    parts = (deep, deep, tilted, tilted)
    for i in range(4):
        for j in range(4):
            shared[i, j] = parts[i] * parts[j] * fit.inverse[i, j]
    remaining: float = _SMOOTH_IN_RESIDUALS * smooth
    for source in range(SOURCES):
        size = budget.sizes[source]
        if size == 0.0:
            continue
        pattern = cells.errors[source]
        remaining += size * size * product(pattern, pattern, first, last)
        for i in range(PARAMETERS):
            response[i] = size * product(cells.jacobian[i], pattern, first, last)
        for i in range(PARAMETERS):
            displacement[i] = 0.0
            for j in range(PARAMETERS):
                displacement[i] += fit.inverse[i, j] * response[j]
            remaining -= displacement[i] * response[i]
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                shared[i, j] += displacement[i] * displacement[j]
    # Variances along and across the tilt direction.
    along = (budget.tilt_error * d / state.grid.radius) ** 2
    across = budget.rotation**2
    shared[TILT_X, TILT_X] += along * n_x * n_x + across * n_y * n_y
    shared[TILT_Y, TILT_Y] += along * n_y * n_y + across * n_x * n_x
    shared[TILT_X, TILT_Y] += (along - across) * n_x * n_y
    shared[TILT_Y, TILT_X] += (along - across) * n_x * n_y
    return 4.0 * max(remaining, 0.0)
