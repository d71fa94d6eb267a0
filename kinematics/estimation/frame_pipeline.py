"""Process one pressure frame in the estimator's only compiled entry point.

The steps are an activity test, outlier rejection and a maximum-likelihood fit. The fit starts from
the last estimate, or from an initial estimate based on the frame alone.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import FloatArray, Records
from softfinger.kinematics.estimation.detection import (
    OUTLIERS_MAX,
    is_noisy,
    presses_outside,
    shows_pattern,
    without_outliers,
)
from softfinger.kinematics.estimation.gauss_newton import fit
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.estimation.moments import start
from softfinger.kinematics.estimation.state import (
    DEPTH,
    GAIN,
    TILT_X,
    TILT_Y,
    Cells,
    EstimatorState,
    Model,
)
from softfinger.kinematics.sensing.solid_pressure import Weights
from softfinger.kinematics.sensing.springs_pressure import SpringPoints

# Signal level in noise standard deviations. A solid tip's frame is faulty if its signal exceeds
# this level but lacks the contact pattern.
_STRONG_SIGNAL = 6.0
# Increase in the detection threshold if noise is clipped at 0. Clipping raises the sums over
# neighbourhoods. The higher threshold restores the false alarm rate.
CLIPPED_LEVEL_INCREASE = 0.5
GAIN_MIN, GAIN_MAX = 0.05, 20.0  # valid range of the gain for a contact of the configured tip
D_MAX = 0.75  # maximum valid d, relative to the radius
R_SQUARED_MIN = 0.8  # a valid estimate explains at least this fraction of the squared pressure
# Maximum relative error of d that a smooth misfit may cause. The limit permits the curved face of a
# disc, because the covariance includes the resulting error. If the gain is far from 1, a smooth
# misfit indicates a different tip. The covariance does not cover a different tip, so a smaller
# limit applies.
UNDETECTED_MAX = 0.6
UNDETECTED_MAX_FAR_GAIN = 0.03
GAIN_FAR = 2.0
# The sensor needs a tare if more than ABOVE_FRACTION of the cells under the tip read high. A
# reading is high if it exceeds both ABOVE_NOISE · noise and ABOVE_PEAK · peak. A solid tip loads
# all cells, but 5 % of the cells read less than 0.32 of the peak.
ABOVE_FRACTION, ABOVE_NOISE, ABOVE_PEAK = 0.95, 3.0, 0.4
FULL_FRACTION_MAX = 0.5  # maximum fraction of saturated cells among the cells above half the peak
ZERO_MAX = 0.22  # maximum ratio of zero-offset error to peak for linear error propagation
SHARED_MAX = 0.5  # maximum standard deviation of d due to known uncertainties, relative to d


@inner_kernel
def _fit_frame(state: EstimatorState, model: Model, frame: FloatArray, cells: Cells) -> Invalid:
    """Fit the contact to a frame by maximum likelihood.

    The fit starts from the last estimate. If the fit fails, it is repeated from an initial estimate
    based on the frame alone.
    """
    estimate = state.estimate
    options = state.options
    signal = state.signal
    reason = Invalid.NOT_CONVERGED
    for attempt in range(0 if estimate.has_last_contact else 1, 2):
        estimate.has_second_contact = False
        if attempt == 1:
            start(state, frame, cells)
        if not options.free_gain:
            estimate.guess[GAIN] = 1.0
        tolerance = options.tolerance if attempt == 0 else min(options.tolerance, 1.0)
        if fit(state, model, frame, cells, tolerance):
            misfit, scatter = _set_r_squared(state)
            if estimate.r_squared < R_SQUARED_MIN:
                reason = Invalid.MODEL_MISMATCH
                continue
            # Search for a second contact only if the misfit exceeds the noise plus a small fraction
            # of the energy. Skip the search for solid tips, which load their whole base.
            if not options.is_solid and misfit > 8.0 * scatter + 0.003 * state.signal.energy:
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
    gain = estimate.guess[GAIN]
    near = 1.0 / GAIN_FAR < gain < GAIN_FAR
    undetected_max = UNDETECTED_MAX if near else UNDETECTED_MAX_FAR_GAIN
    if estimate.undetected > undetected_max or not GAIN_MIN < gain < GAIN_MAX:
        return Invalid.MODEL_MISMATCH
    within = estimate.guess[DEPTH] < D_MAX * state.grid.radius
    return Invalid.NONE if within else Invalid.OUT_OF_RANGE


@inner_kernel
def _set_r_squared(state: EstimatorState) -> tuple[float, float]:
    """Set r², the fraction of the frame's squared pressure (minus noise) that the model explains.

    Returns the unexplained part and the scatter of the noise, both in Pa².
    """
    energy = state.signal.energy
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
def _set_results(state: EstimatorState) -> None:
    """Convert the fit parameters and their covariance to d, tilts in finger axes, and gain."""
    estimate = state.estimate
    fit = state.fit
    guess = estimate.guess
    c = math.cos(state.options.rotation)
    s = math.sin(state.options.rotation)
    n_x = c * guess[TILT_X] - s * guess[TILT_Y]
    n_y = s * guess[TILT_X] + c * guess[TILT_Y]
    estimate.d, estimate.gain = guess[DEPTH], guess[GAIN]
    estimate.tilt_x, estimate.tilt_y = math.asin(n_x), math.asin(n_y)
    if not fit.variance > 0.0:
        return
    # ∂tilt/∂n = 1/cos tilt.
    per_x = 1.0 / math.sqrt(1.0 - n_x * n_x)
    per_y = 1.0 / math.sqrt(1.0 - n_y * n_y)
    partials = fit.to_results
    partials[0, DEPTH] = partials[3, GAIN] = 1.0
    partials[1, TILT_X], partials[1, TILT_Y] = per_x * c, -per_x * s
    partials[2, TILT_X], partials[2, TILT_Y] = per_y * s, per_y * c
    for i in range(4):
        for j in range(i + 1):
            noise = other = 0.0
            for k in range(4):
                for m in range(4):
                    both = partials[i, k] * partials[j, m]
                    noise += both * fit.inverse[k, m]
                    other += both * state.budget.shared[k, m]
            other *= fit.widening
            noise = fit.variance * noise + other
            estimate.covariance[i, j] = estimate.covariance[j, i] = noise
            estimate.systematic[i, j] = estimate.systematic[j, i] = other


@inner_kernel
def _fault_in_readings(
    state: EstimatorState, frame: FloatArray, height: FloatArray, reason: Invalid
) -> Invalid:
    """Return the fault in the readings that caused the failure; by default, return ``reason``."""
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
    """Estimate the contact in a frame; return the reason for an invalid estimate, or ``NONE``."""
    fit = state.fit
    reason = _fit_frame(state, model, frame, cells)
    _set_results(state)
    if state.options.is_solid and reason == Invalid.NOT_CONVERGED:
        # For a real contact, the fit converges within the data range or matches the frame at the
        # limit of the range.
        unexplained = fit.misfit > (1.0 - R_SQUARED_MIN) * fit.readings
        reason = Invalid.MODEL_MISMATCH if unexplained or not fit.is_limited else reason
    if reason != Invalid.NONE:
        reason = _fault_in_readings(state, frame, cells.height, reason)
    return reason


@inner_kernel
def _reset_results(state: EstimatorState, scale: float, step: float, saturation: float) -> None:
    """Set the unit and noise of the frame, and clear all results except the last contact."""
    options = state.options
    signal = state.signal
    grid = state.grid
    signal.number = options.number
    signal.scale = scale
    signal.is_clipped = step > 0.0
    signal.variance = options.noise**2 + step * step / 12.0
    signal.noise = math.sqrt(signal.variance) / scale
    signal.saturation = saturation * scale
    signal.floor = options.floor * scale if step > 0.0 or options.floor > 0.0 else -math.inf
    signal.patch_level = options.patch_level + (CLIPPED_LEVEL_INCREASE if step > 0.0 else 0.0)
    # A contact that is no wider than a cell causes a strain of at most about pitch²/(2a²). The
    # maximum reading allows for a gain of up to 12.
    pitch = max(grid.pitch_x, grid.pitch_y)
    signal.narrow_contact_max = 6.0 * options.modulus * (pitch / grid.radius) ** 2 / scale
    estimate = state.estimate
    estimate.gain = 1.0
    estimate.d = estimate.tilt_x = estimate.tilt_y = estimate.shear_x = estimate.shear_y = 0.0
    estimate.chi2 = estimate.r_squared = estimate.undetected = estimate.shared = 0.0
    estimate.cells = estimate.iterations = 0
    estimate.has_second_contact = False
    estimate.covariance[:] = 0.0
    estimate.systematic[:] = 0.0


@kernel
def estimate_frame(
    states: Records[EstimatorState], frame: FloatArray, scale: float, step: float,
    saturation: float, cells: Cells, points: SpringPoints, pixels: FloatArray,
    weights: Records[Weights],
) -> None:  # fmt: skip
    """Estimate the contact in one frame and store the result in the state (compiled entry point).

    ``frame`` [cells] is float64 in counts, and ``scale`` is in Pa per count. ``step`` is the size
    of a quantum [Pa], or 0. Cells saturate at ``saturation`` counts. ``points`` is the model of a
    spring tip. ``pixels`` and ``weights`` are the images of a solid tip.
    """
    state = states[0]
    model = Model(points, pixels, weights[0])
    estimate = state.estimate
    signal = state.signal
    _reset_results(state, scale, step, saturation)
    for k in range(frame.shape[0]):
        cells.height[k] = cells.reach[k]
    rejected = without_outliers(state, frame, cells.height)
    strong = False
    if state.options.is_solid and signal.is_finite:
        # Every contact of a solid tip matches the contact pattern. A strong signal without the
        # pattern is therefore not a contact. A small common zero offset does not count as a signal.
        level = max(signal.mean, signal.peak - signal.mean)
        strong = signal.contact and level > _STRONG_SIGNAL * signal.noise
        signal.contact = shows_pattern(state, frame, cells)
    unexplained = not signal.contact and (strong or is_noisy(state, frame, cells.height))
    estimate.peak = signal.peak * scale
    estimate.rejected_count = rejected
    estimate.contact = signal.contact or unexplained
    reason = Invalid.NONE
    if signal.contact:
        reason = _estimate(state, model, frame, cells)
    else:
        estimate.covariance[0, 0] = state.options.undetected**2
        estimate.systematic[0, 0] = state.options.undetected**2
        if unexplained:
            reason = _fault_in_readings(state, frame, cells.height, Invalid.MODEL_MISMATCH)
    estimate.has_last_contact = signal.contact and reason == Invalid.NONE
    if not signal.is_finite:
        reason = Invalid.NOT_FINITE
    elif not signal.mean > -3.0 * signal.noise:
        # If the baseline is far below zero, the sensor needs a tare.
        reason = Invalid.BELOW_ZERO
    elif rejected == OUTLIERS_MAX:
        reason = Invalid.OUTLIERS
    estimate.invalid = reason
