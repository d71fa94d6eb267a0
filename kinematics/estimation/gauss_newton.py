"""Kernels for the Gauss-Newton fit of a contact to one pressure frame.

The parameters are the gain, d, n_x and n_y. For solid tips, the shear force along x and y is fitted
as well. Each step uses the pressures and partials from the tip's forward model.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.estimation.error_budget import (
    product,
    set_shared_errors,
    undetected_misfit,
    widen_covariance,
)
from softfinger.kinematics.estimation.state import (
    DEPTH,
    GAIN,
    PARAMETERS,
    SHEAR_X,
    SHEAR_Y,
    TILT_X,
    TILT_Y,
    Cells,
    EstimatorState,
    Fit,
    Model,
    Options,
)
from softfinger.kinematics.sensing.footprint import set_face
from softfinger.kinematics.sensing.solid_pressure import own_shear, press_solid
from softfinger.kinematics.sensing.springs_pressure import press_springs

# If the gain is free, the covariance is multiplied by 1 + _GAIN_CURVATURE (σ_d/d)². The factor was
# fitted to simulated frames over the operating range. The fit compared the squared errors with the
# linear prediction.
_GAIN_CURVATURE = 6.0
_ITERATIONS = 20
_HALVINGS_MAX = 5
# Prior standard deviation of a solid tip's shear force, relative to its normal force.
_SHEAR_PRIOR = 0.1
CELLS_MIN = 9  # minimum number of cells for estimating a solid tip's contact and shear
_SPRINGS_CELLS_MIN = 5  # minimum number of cells for estimating a spring tip's contact
_LIMITED_MAX = 4  # maximum number of consecutive steps clamped to the limits of the model
_LOG_STEP_MAX = 2.0  # maximum step of the logarithm of d or of the gain
_STEP_MARGIN = 1.01  # factor by which a solid-tip fit may exceed the range of the data
# Minimum pivot of a scaled normal matrix. For a 2 × 2 matrix, the pivot is the determinant divided
# by the product of the diagonal elements. The rounding error of a pivot is 1e-12.
_PIVOT_MIN = 1e-11

# A cell cannot read below its floor, which is 0 or the smallest count that the board sends.
# Clipping at the floor raises the mean reading above the true pressure. At z standard deviations
# above the floor, the excess is E[max(z + e, 0)] − z = E[max(e − z, 0)] standard deviations with e
# ~ N(0, 1). The product of (1 − z/CLIP_END)² and the polynomial with coefficients CLIP approximates
# the excess to within 3e-4. Cells more than CLIP_BELOW standard deviations below the floor provide
# almost no information.
CLIP_END = 3.5
CLIP_BELOW = 2.0
CLIP = (0.399207, -0.275277, 0.0188358, 0.0260713, -0.00538491)


@inner_kernel
def parameters(options: Options) -> tuple[int, int]:
    """Return the half-open index range of the fitted parameters."""
    return GAIN if options.free_gain else DEPTH, PARAMETERS if options.is_solid else SHEAR_X


@inner_kernel
def press(state: EstimatorState, model: Model, cells: Cells) -> tuple[int, int]:
    """Evaluate the model at the current contact; return the range of affected cells."""
    fit = state.fit
    d, n_x, n_y = fit.contact[DEPTH], fit.contact[TILT_X], fit.contact[TILT_Y]
    if state.options.is_solid:
        press_solid(model.weights, model.pixels, d, n_x, n_y, cells.sensitivity[:SHEAR_X])
        return 0, cells.height.shape[0]
    set_face(fit.face, state.grid.radius, d, n_x, n_y)
    first, last = press_springs(model.points, state.grid, fit.face, state.around, cells.planes)
    return first * state.grid.cols, last * state.grid.cols


@inner_kernel
def free_noise(square: float, floor: float) -> float:
    """Return the noise σ [Pa] of a cell; ``square`` [Pa²] is the mean of y², the squared readings.

    Readings below ``floor`` [Pa] are sent as 0, so E[y²] = σ²(τ φ(τ) + Q(τ)) with τ = floor/σ. For
    a floor of 0, E[y²] is σ²/2. If all unloaded cells read 0, σ is slightly less than a third of
    the floor.
    """
    if not floor > 0.0:
        return math.sqrt(2.0 * square)
    target = square / (floor * floor)
    low = 0.05
    high = 3.2
    for _ in range(9):
        tau = 0.5 * (low + high)
        clipped_part = tau * math.exp(-0.5 * tau * tau) / math.sqrt(2.0 * math.pi)
        clipped_part += 0.5 * math.erfc(tau / math.sqrt(2.0))
        if clipped_part > target * tau * tau:
            low = tau
        else:
            high = tau
    return 2.0 * floor / (low + high)


@fast_inner_kernel
def _clip_noise(
    state: EstimatorState, frame: FloatArray, cells: Cells, first: int, last: int
) -> float:
    """Estimate the noise [Pa] of cells clipped at the floor from the unloaded cells.

    The result is at most the expected noise.
    """
    signal = state.signal
    energy = number = 0.0
    for k in range(first, last):
        inside = (cells.sensitivity[GAIN, k] != 0.0) & (cells.height[k] >= 0.0)
        energy += frame[k] * frame[k] if inside else 0.0
        number += 1.0 if inside else 0.0
    clip = math.sqrt(signal.variance)
    number = float(signal.number) - number
    if number >= 16.0:
        free_square = max(signal.energy - energy * signal.scale * signal.scale, 0.0) / number
        clip = min(clip, free_noise(free_square, signal.floor))
    return clip


@fast_inner_kernel
def compare(state: EstimatorState, frame: FloatArray, cells: Cells, first: int, last: int) -> None:
    """Compute the model, residual and response of each cell, and the sums of squares.

    A cell never reads below 0 or below the floor, even where the rubber is in tension. A saturated
    cell is used only if the modelled pressure is below saturation. If ``fit.clip_noise`` is
    positive, the noise is clipped at the floor. Otherwise, cells with a modelled pressure below the
    floor are excluded.
    """
    fit = state.fit
    gain, shear_x, shear_y = fit.contact[GAIN], fit.contact[SHEAR_X], fit.contact[SHEAR_Y]
    saturation = state.signal.saturation
    scale = state.signal.scale
    floor = state.signal.floor
    clip = fit.clip_noise
    clipped = clip > 0.0
    per_clip = 1.0 / clip if clipped else 0.0
    # Without a floor, ``floor`` is −∞.
    lower = floor - CLIP_BELOW * clip
    misfit = readings = weight = 0.0
    for k in range(first, last):
        raw = frame[k] * scale
        model = gain * cells.sensitivity[GAIN, k]
        model += shear_x * cells.sensitivity[SHEAR_X, k] + shear_y * cells.sensitivity[SHEAR_Y, k]
        pressure = max(model, 0.0)
        response = 1.0 if model > 0.0 else 0.0
        reading = max(raw, floor)
        residual = reading - pressure
        if clipped:
            # The mean reading minus max(pressure, floor) is symmetric about the floor.
            depth = (pressure - floor) * per_clip
            z = min(abs(depth), CLIP_END)
            above = 1.0 - z * (1.0 / CLIP_END)
            base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
            rise = CLIP[1] + z * (2.0 * CLIP[2] + z * (3.0 * CLIP[3] + z * 4.0 * CLIP[4]))
            rise = above * (above * rise - (2.0 / CLIP_END) * base)
            residual = reading - max(pressure, floor) - clip * above * above * base
            response *= 1.0 + rise if depth >= 0.0 else -rise
        inside = (cells.sensitivity[GAIN, k] != 0.0) & (cells.height[k] >= 0.0)
        counts = inside & ((raw < saturation) | (model < saturation)) & (pressure >= lower)
        residual = residual if counts else 0.0
        cells.model[k] = model
        cells.residual[k] = residual
        cells.factor[k] = response if counts else 0.0
        misfit += residual * residual
        readings += raw * raw if inside else 0.0
        weight += 1.0 if counts else 0.0
    fit.misfit = misfit
    fit.readings = readings
    fit.counted_cells = weight


@fast_inner_kernel
def _weigh(cells: Cells, row: int, gain: float, first: int, last: int) -> None:
    """Set one row of the Jacobian."""
    for k in range(first, last):
        cells.jacobian[row, k] = gain * cells.factor[k] * cells.sensitivity[row, k]


@inner_kernel
def _accumulate(state: EstimatorState, cells: Cells, begin: int, end: int) -> None:
    """Compute the Jacobian J, JᵀJ and Jᵀr over the cells from ``begin`` to ``end``."""
    fit = state.fit
    rows = cells.jacobian
    _, last = parameters(state.options)
    for i in range(last):
        _weigh(cells, i, fit.contact[GAIN] if DEPTH <= i <= TILT_Y else 1.0, begin, end)
        fit.gradient[i] = product(rows[i], cells.residual, begin, end)
        for j in range(i + 1):
            fit.normal[i, j] = product(rows[i], rows[j], begin, end)


@inner_kernel
def linearise(state: EstimatorState, model: Model, frame: FloatArray, cells: Cells) -> float:
    """Set up the normal equations at the current contact; return the cost [Pa²] minus Σ reading².

    The shear force has a prior whose standard deviation is proportional to the normal force.
    """
    fit = state.fit
    fit.first_cell, fit.last_cell = press(state, model, cells)
    first, last = index(fit.first_cell), index(fit.last_cell)
    fit.clip_noise = 0.0
    if state.signal.is_clipped:
        fit.clip_noise = _clip_noise(state, frame, cells, first, last)
    compare(state, frame, cells, first, last)
    _accumulate(state, cells, first, last)
    cost: float = fit.misfit - fit.readings
    if state.options.is_solid:
        likely = _SHEAR_PRIOR * max(fit.contact[GAIN] * model.weights.values[0, 0], 1e-9)
        prior = state.signal.variance / (likely * likely)
        for k in range(SHEAR_X, PARAMETERS):
            fit.normal[k, k] += prior
            fit.gradient[k] -= prior * fit.contact[k]
            cost += prior * fit.contact[k] * fit.contact[k]
    return cost


@inner_kernel
def solve(fit: Fit, first: int, last: int) -> bool:
    """Solve the normal equations for a range of parameters; set step, inverse and decrement.

    Returns False if a pivot of the scaled matrix is too small, because the frame then does not
    determine all parameters.
    """
    normal = fit.normal
    inverse = fit.inverse
    scale = fit.scale
    inverse[:] = 0.0
    for i in range(first, last):
        if not normal[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(normal[i, i])
        for j in range(first, i + 1):
            inverse[i, j] = inverse[j, i] = normal[i, j] * scale[i] * scale[j]
    # Applying the sweep operator to each diagonal element replaces the matrix by its negative
    # inverse.
    for k in range(first, last):
        pivot = inverse[k, k]
        if not pivot > _PIVOT_MIN:
            return False
        for i in range(first, last):
            for j in range(first, last):
                if i != k and j != k:
                    inverse[i, j] -= inverse[i, k] * inverse[k, j] / pivot
        for i in range(first, last):
            inverse[i, k] /= pivot
            inverse[k, i] = inverse[i, k]
        inverse[k, k] = -1.0 / pivot
    fit.step[:] = 0.0
    fit.decrement = 0.0
    for i in range(first, last):
        for j in range(first, last):
            inverse[i, j] *= -scale[i] * scale[j]
            fit.step[i] += inverse[i, j] * fit.gradient[j]
        fit.decrement += fit.step[i] * fit.gradient[i]
    return math.isfinite(fit.decrement)


@inner_kernel
def _apply_step(state: EstimatorState) -> bool:
    """Apply the step, clamped to the model's limits; return False if d was clamped."""
    fit = state.fit
    options = state.options
    contact = fit.contact
    for i in range(PARAMETERS):
        fit.previous[i] = contact[i]
        contact[i] += fit.step[i]
    if options.is_solid and options.free_gain:
        # A frame determines the product of gain and force much better than the factors, and the
        # force is nearly a power of d. Steps in the logarithms preserve the product.
        for i in range(GAIN, TILT_X):
            relative = fit.step[i] / fit.previous[i]
            contact[i] = fit.previous[i] * math.exp(min(relative, _LOG_STEP_MAX))
    contact[GAIN] = max(contact[GAIN], 0.2 * fit.previous[GAIN])
    tilt = math.hypot(contact[TILT_X], contact[TILT_Y])
    margin = _STEP_MARGIN if options.is_solid else 1.0
    sine_max = margin * options.sine_max
    deepest = margin * options.deepest
    fit.is_limited = tilt > sine_max
    if fit.is_limited:
        contact[TILT_X] *= sine_max / tilt
        contact[TILT_Y] *= sine_max / tilt
    d = contact[DEPTH]
    fit.is_limited = fit.is_limited or d > deepest
    least = max(0.3 * fit.previous[DEPTH], 1e-4 * state.grid.radius)
    contact[DEPTH] = min(max(d, least), deepest)
    return bool(d == contact[DEPTH])


@inner_kernel
def _check_fit(state: EstimatorState, cells: Cells) -> float:
    """Compute χ² of the solved fit, and the covariance due to common errors and smooth misfit.

    Returns the noise variance [Pa²], or a negative value if there are too few cells. The variance
    is increased if the misfit exceeds its expected scatter. The returned variance times
    ``fit.inverse`` is the covariance due to noise.
    """
    fit = state.fit
    estimate = state.estimate
    budget = state.budget
    variance = state.signal.variance
    first, last = parameters(state.options)
    freedom = fit.counted_cells - (last - first)
    misfit = max(fit.misfit - fit.decrement, 0.0)
    estimate.cells = int(fit.counted_cells)
    estimate.residual = misfit - fit.readings
    expected = undetected = 0.0
    budget.shared[:] = 0.0
    if budget.has_common_errors:
        expected = set_shared_errors(state, cells)
        estimate.shared = math.sqrt(budget.shared[DEPTH, DEPTH]) / fit.contact[DEPTH]
    beyond = misfit - expected - variance * freedom
    if beyond > variance * math.sqrt(2.0 * max(freedom, 0.0)):
        undetected = undetected_misfit(state, cells, beyond)
        estimate.undetected = math.sqrt(undetected * fit.inverse[DEPTH, DEPTH]) / fit.contact[DEPTH]
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                budget.shared[i, j] += undetected * fit.inverse[i, j]
    if budget.is_correlated:
        freedom = fit.counted_cells - widen_covariance(state) - (last - SHEAR_X)
    freedom = max(freedom, 1.0)
    estimate.chi2 = misfit / (variance * freedom + expected)
    excess = max(estimate.chi2 - 3.0 * math.sqrt(2.0 * budget.cells_per_sample / freedom), 1.0)
    least = CELLS_MIN if state.options.is_solid else _SPRINGS_CELLS_MIN
    return variance * excess if fit.counted_cells >= least else -1.0


@inner_kernel
def _finish(state: EstimatorState, model: Model, cells: Cells, iterations: int) -> bool:
    """Set the estimate after the fit; return False if there are too few cells.

    ``fit.inverse`` times ``fit.variance`` is the covariance due to noise. ``budget.shared`` times
    ``fit.widening`` is the covariance due to other errors.
    """
    fit = state.fit
    estimate = state.estimate
    options = state.options
    contact = estimate.guess
    for i in range(PARAMETERS):
        contact[i] = fit.contact[i]
    d = contact[DEPTH]
    square = contact[TILT_X] * contact[TILT_X] + contact[TILT_Y] * contact[TILT_Y]
    if options.is_solid:
        area = state.grid.radius * state.grid.radius
        along = area * math.cos(options.rotation)
        across = area * math.sin(options.rotation)
        own = contact[GAIN] * own_shear(model.weights, d, square)
        x = contact[SHEAR_X] + own * contact[TILT_X]
        y = contact[SHEAR_Y] + own * contact[TILT_Y]
        estimate.shear_x = along * x - across * y
        estimate.shear_y = across * x + along * y
    # Clamp the result, because noise may move the fit beyond the limits of the model.
    within = min(1.0, options.sine_max / max(math.sqrt(square), 1e-9))
    contact[DEPTH] = min(d, options.deepest)
    contact[TILT_X] *= within
    contact[TILT_Y] *= within
    estimate.iterations = iterations
    variance = _check_fit(state, cells)
    fit.widening = 1.0
    if options.free_gain:
        # As the uncertainty of d increases, the relation between d and the gain becomes less
        # linear.
        uncertain = variance * fit.inverse[DEPTH, DEPTH] + state.budget.shared[DEPTH, DEPTH]
        fit.widening += _GAIN_CURVATURE * min(uncertain / (d * d), 1.0)
    fit.variance = fit.widening * variance
    return bool(variance > 0.0)


@inner_kernel
def fit(
    state: EstimatorState, model: Model, frame: FloatArray, cells: Cells, tolerance: float
) -> bool:
    """Run the Gauss-Newton method; ``state.estimate`` contains the guess and receives the result.

    The iteration stops when the predicted decrement is at most ``tolerance`` · variance.
    ``tolerance`` is the squared ratio of the step to the noise floor. Returns False if the
    iteration does not converge, or if the frame does not determine a contact within the limits of
    the model.
    """
    fit = state.fit
    variance = state.signal.variance
    first, last = parameters(state.options)
    fit.variance = 0.0
    for i in range(PARAMETERS):
        fit.contact[i] = state.estimate.guess[i]
    fit.contact[DEPTH] = min(fit.contact[DEPTH], state.options.deepest)
    before = math.inf
    halvings = 0
    limited = 0
    for iteration in range(_ITERATIONS):
        cost = linearise(state, model, frame, cells)
        if iteration > 0 and not cost <= before + variance and halvings < _HALVINGS_MAX:
            # Halve the step, because the cost has increased.
            in_logarithms = state.options.is_solid and state.options.free_gain
            for i in range(PARAMETERS):
                if in_logarithms and i < TILT_X:
                    fit.contact[i] = math.sqrt(fit.contact[i] * fit.previous[i])
                else:
                    fit.contact[i] = 0.5 * (fit.contact[i] + fit.previous[i])
            halvings += 1
            continue
        before = cost
        if not solve(fit, first, last):
            return False
        halvings = 0
        is_free = _apply_step(state)
        limited = limited + 1 if fit.is_limited else 0
        if limited == _LIMITED_MAX:
            return False
        if fit.decrement <= tolerance * variance and is_free:
            return _finish(state, model, cells, iteration + 1)
    return False
