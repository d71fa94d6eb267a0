"""Processing of one pressure frame, with the estimator's only compiled entry point.

The steps are the activity test, the outlier rejection, and a maximum likelihood fit. The fit starts
from the last estimate, or from an initial estimate based on the frame alone.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.estimation.detection import (
    STRONG_PEAK,
    is_noisy,
    presses_outside,
    restore_outliers,
    shows_pattern,
    without_outliers,
)
from softfinger.kinematics.estimation.gauss_newton import fit, squared_sum
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.estimation.moments import start
from softfinger.kinematics.estimation.state import (
    OUTLIERS_MAX,
    Cells,
    EstimatorState,
    Images,
    Matrix,
    Model,
    cells_in,
)
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.solid_pressure import Weights
from softfinger.kinematics.sensing.springs_pressure import SpringPoints

# Clipping the noise at 0 raises the sums over neighbourhoods. Raising the detection level by this
# amount restores the false alarm rate.
CLIPPED_LEVEL_INCREASE = 0.5
GAIN_MIN, GAIN_MAX = 0.05, 20.0  # range of the gain for a contact of this tip on this sensor
D_MAX = 0.75  # maximum valid d, relative to the radius
# Maximum relative error of d that a smooth misfit may cause. The curved face of a disc causes an
# error of this size, which the covariance includes. A smaller limit applies if the gain is far from
# 1. Such a gain together with a smooth misfit indicates a different tip, which the covariance does
# not cover.
UNDETECTED_MAX = 0.6
UNDETECTED_MAX_FAR_GAIN = 0.03
GAIN_FAR = 2.0
# The sensor needs a tare if at least ABOVE_FRACTION of the cells under the tip exceed both levels,
# one relative to the noise and one relative to the peak. A solid tip loads all cells, but 5 % of
# them read less than 0.32 of the peak.
ABOVE_FRACTION, ABOVE_NOISE, ABOVE_PEAK = 0.95, 3.0, 0.4
FULL_FRACTION_MAX = 0.5  # maximum fraction of saturated cells among the cells above half the peak
ZERO_MAX = 0.22  # maximum ratio of zero-offset error to peak for linear error propagation
SHARED_MAX = 0.5  # maximum standard deviation of d due to known uncertainties, relative to d


@inner_kernel
def _fit_frame(state: EstimatorState, model: Model, frame: FloatArray, cells: Cells) -> Invalid:
    """Fit by maximum likelihood from the last estimate or, if this fails, from the frame alone."""
    estimate = state.estimate
    options = state.options
    signal = state.signal
    energy = squared_sum(state)
    reason = Invalid.NOT_CONVERGED
    for attempt in range(2):
        if attempt == 0 and not estimate.has_last_contact:
            continue
        estimate.has_second_contact = False
        if attempt == 1:
            start(state, frame, cells)
        if not options.free_gain:
            estimate.gain = 1.0
        tolerance = options.tolerance if attempt == 0 else min(options.tolerance, 1.0)
        if fit(state, model, frame, cells, tolerance):
            misfit, scatter = _set_r_squared(state)
            if estimate.r_squared < options.r_squared_min:
                reason = Invalid.MODEL_MISMATCH
                continue
            # Search for a second contact only if the residual exceeds the noise and a small
            # fraction of the energy. Skip this search for solid tips, which load their whole base.
            if not options.is_solid and misfit > 8.0 * scatter + 0.003 * energy:
                level = max(5.0 * signal.noise, 0.15 * estimate.peak / signal.scale)
                level += 2.0 * state.budget.baseline / signal.scale
                estimate.has_second_contact = presses_outside(state, frame, cells.height, level)
            if not estimate.has_second_contact:
                return _check_fit_of_tip(state)
            reason = Invalid.SECOND_CONTACT
    return reason


@inner_kernel
def _check_fit_of_tip(state: EstimatorState) -> Invalid:
    """Check that the misfit is consistent with the tip model and that d is accurate enough."""
    estimate = state.estimate
    zero = math.hypot(state.budget.baseline, state.budget.slope)
    if estimate.shared > SHARED_MAX or zero > ZERO_MAX * estimate.peak:
        return Invalid.UNCERTAIN
    near = 1.0 / GAIN_FAR < estimate.gain < GAIN_FAR
    if estimate.undetected > (UNDETECTED_MAX if near else UNDETECTED_MAX_FAR_GAIN):
        return Invalid.MODEL_MISMATCH
    return Invalid.NONE


@inner_kernel
def _set_r_squared(state: EstimatorState) -> tuple[float, float]:
    """Set r², the fraction of the frame's squared pressure (minus noise) that the model explains.

    Returns the unexplained part [Pa²] and the scatter of the noise.
    """
    energy = squared_sum(state)
    budget = state.budget
    estimate = state.estimate
    number = float(state.signal.number)
    shift = budget.baseline * budget.baseline
    noise = number * (state.signal.variance + shift)
    scatter = (
        state.signal.variance * math.sqrt(2.0 * number * budget.cells_per_sample) + shift * number
    )
    misfit = max(energy + estimate.residual - noise, 0.0)
    power = max(energy - noise, scatter)
    estimate.r_squared = 1.0 - min(max(misfit - 4.0 * scatter, 0.0) / power, 1.0)
    return misfit, scatter


@inner_kernel
def _to_tilts(state: EstimatorState, covariance: Matrix, rotated: Matrix) -> None:
    """Convert the estimate from normals in sensor axes to tilts in finger axes.

    The ``covariance`` is converted into ``rotated`` and overwritten.
    """
    estimate = state.estimate
    c = math.cos(state.options.rotation)
    s = math.sin(state.options.rotation)
    n_x = c * estimate.n_x - s * estimate.n_y
    n_y = s * estimate.n_x + c * estimate.n_y
    estimate.tilt_x = math.asin(n_x)
    estimate.tilt_y = math.asin(n_y)
    # Because ∂tilt/∂n = 1/cos tilt, only the two middle rows and columns must be scaled.
    per_x = 1.0 / math.sqrt(1.0 - n_x * n_x)
    per_y = 1.0 / math.sqrt(1.0 - n_y * n_y)
    for j in range(4):
        along = covariance[1, j]
        across = covariance[2, j]
        covariance[1, j] = per_x * (c * along - s * across)
        covariance[2, j] = per_y * (s * along + c * across)
    for i in range(4):
        along = covariance[i, 1]
        across = covariance[i, 2]
        rotated[i, 0] = covariance[i, 0]
        rotated[i, 1] = per_x * (c * along - s * across)
        rotated[i, 2] = per_y * (s * along + c * across)
        rotated[i, 3] = covariance[i, 3]


@inner_kernel
def _fault_in_readings(
    state: EstimatorState, frame: FloatArray, height: FloatArray, reason: Invalid
) -> Invalid:
    """Return the fault in the readings that explains a failed estimate, otherwise ``reason``."""
    signal = state.signal
    level = max(ABOVE_NOISE * signal.noise, ABOVE_PEAK * signal.peak)
    above = pressed = full = 0
    for k in range(frame.shape[0]):
        if height[k] >= 0.0:
            above += frame[k] > level
            pressed += frame[k] > 0.5 * signal.peak
            full += frame[k] * signal.scale >= signal.saturation
    if full > FULL_FRACTION_MAX * pressed:
        return Invalid.SATURATED
    return Invalid.ABOVE_ZERO if above > ABOVE_FRACTION * state.signal.number else reason


@inner_kernel
def _estimate(state: EstimatorState, model: Model, frame: FloatArray, cells: Cells) -> Invalid:
    """Estimate the contact in a frame; return the reason if the estimate is invalid."""
    estimate = state.estimate
    reason = _fit_frame(state, model, frame, cells)
    fit = state.fit
    if state.options.is_solid and reason == Invalid.NOT_CONVERGED:
        # For a contact of this tip, the fit either converges within the data range or explains the
        # frame at the limit of the range.
        unexplained = fit.misfit > (1.0 - state.options.r_squared_min) * fit.readings
        reason = Invalid.MODEL_MISMATCH if unexplained or not fit.is_limited else reason
    if reason == Invalid.NONE and not GAIN_MIN < estimate.gain < GAIN_MAX:
        reason = Invalid.MODEL_MISMATCH
    if reason == Invalid.NONE and not estimate.d < D_MAX * state.grid.radius:
        reason = Invalid.OUT_OF_RANGE
    if reason != Invalid.NONE:
        reason = _fault_in_readings(state, frame, cells.height, reason)
    _to_tilts(state, state.fit.covariance, estimate.covariance)
    if state.budget.has_common_errors or estimate.undetected > 0.0:
        _to_tilts(state, state.budget.covariance, estimate.systematic)
        for i in range(4):
            for j in range(4):
                estimate.covariance[i, j] += estimate.systematic[i, j]
    return reason


@inner_kernel
def _reset_results(state: EstimatorState, scale: float, step: float) -> None:
    """Set the frame unit and clear all previous results except the contact."""
    options = state.options
    signal = state.signal
    grid = state.grid
    signal.scale = scale
    signal.is_clipped = step > 0.0
    signal.variance = options.noise**2 + step * step / 12.0
    signal.noise = math.sqrt(signal.variance) / scale
    signal.saturation = options.saturation * scale
    signal.floor = options.floor * scale if step > 0.0 or options.floor > 0.0 else -math.inf
    signal.patch_level = options.patch_level + (CLIPPED_LEVEL_INCREASE if step > 0.0 else 0.0)
    # A contact that is no wider than a cell causes a strain of at most about pitch²/2a². Allow for
    # gains of up to 3.
    pitch = max(grid.pitch_x, grid.pitch_y)
    signal.narrow_contact_max = 6.0 * options.modulus * (pitch / grid.radius) ** 2 / scale
    estimate = state.estimate
    estimate.chi2 = 0.0
    estimate.tilt_x = 0.0
    estimate.tilt_y = 0.0
    estimate.r_squared = 0.0
    estimate.cells = 0
    estimate.iterations = 0
    estimate.has_second_contact = False
    estimate.undetected = 0.0
    estimate.shared = 0.0
    estimate.shear_x = 0.0
    estimate.shear_y = 0.0
    estimate.covariance[:] = 0.0
    estimate.systematic[:] = 0.0
    state.budget.covariance[:] = 0.0


@kernel
def estimate_frame(
    states: Records[EstimatorState],
    frame: FloatArray,
    scale: float,
    step: float,
    rows: FloatArray,
    pixels: FloatArray,
    weights: Records[Weights],
    line: FloatArray,
    inverse: FloatArray,
    y: FloatArray,
    across: FloatArray,
    along: FloatArray,
    law: FloatArray,
    sums: FloatArray,
) -> None:
    """Estimate the contact in one frame and store the result in the state (compiled entry point).

    ``frame`` is float64 [cells] in counts, ``scale`` is in Pa per count, and ``step`` is the
    quantum size [Pa] or 0. ``rows`` stores the `state.Cells`. ``pixels`` and ``weights`` are the
    `state.Images` of a solid tip. The remaining arguments are the `SpringPoints` of a spring tip.
    """
    state = states[0]
    cells = cells_in(rows, state.grid)
    points = SpringPoints(line, inverse, y, across, along, law, sums)
    model = Model(points, Images(pixels, weights[0]))
    estimate = state.estimate
    signal = state.signal
    _reset_results(state, scale, step)
    rejected = without_outliers(state, frame, cells.height)
    strong = False
    if state.options.is_solid and signal.is_finite:
        # Every contact of a solid tip matches the pattern, so a strong signal without the pattern
        # is not a contact of this tip. A small common zero offset does not count as a signal.
        level = max(signal.mean, signal.peak - signal.mean)
        strong = signal.contact and level > STRONG_PEAK * signal.noise
        signal.contact = shows_pattern(state, frame, cells)
    unexplained = not signal.contact and (strong or is_noisy(state, frame, cells.height))
    estimate.peak = signal.peak * scale
    estimate.rejected_count = rejected
    estimate.contact = signal.contact or unexplained
    reason = Invalid.NONE
    if signal.contact:
        reason = _estimate(state, model, frame, cells)
    else:
        estimate.d = 0.0
        estimate.n_x = 0.0
        estimate.n_y = 0.0
        estimate.gain = 1.0
        estimate.covariance[0, 0] = state.options.undetected**2
        estimate.systematic[0, 0] = state.options.undetected**2
        if unexplained:
            reason = _fault_in_readings(state, frame, cells.height, Invalid.MODEL_MISMATCH)
    estimate.has_last_contact = signal.contact and reason == Invalid.NONE
    if not signal.is_finite:
        reason = Invalid.NOT_FINITE
    elif not signal.mean > -3.0 * signal.noise:
        # A baseline far below zero means that the sensor needs a tare.
        reason = Invalid.BELOW_ZERO
    elif rejected == OUTLIERS_MAX:
        reason = Invalid.OUTLIERS
    estimate.invalid = reason
    restore_outliers(state, rejected, cells.height)
