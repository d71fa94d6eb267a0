"""Kernels for the Gauss-Newton fit of a contact to one pressure frame.

The parameters are the gain, d, n_x, n_y and, for solid tips, the shear force on the face along x
and y. Each step uses the pressures and partials from the tip's forward model.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.estimation.error_budget import (
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
    Images,
    Matrix,
    Model,
    Normal,
    Options,
)
from softfinger.kinematics.sensing.footprint import FloatArray, set_face
from softfinger.kinematics.sensing.solid_pressure import own_shear, press_solid
from softfinger.kinematics.sensing.springs_pressure import press_springs

# If the gain is free, the covariance is multiplied by 1 + _GAIN_CURVATURE (σ_d/d)². The factor was
# determined by comparing squared errors with the linear prediction, using simulated frames over the
# operating range.
_GAIN_CURVATURE = 6.0
_HALVINGS_MAX = 5
_LIMITED_MAX = 4  # maximum number of consecutive steps that are clamped to the limits of the model
# Minimum pivot of a scaled normal matrix. For a 2 × 2 matrix, the pivot is the determinant divided
# by the product of the diagonal elements, with a rounding error of 1e-12.
_PIVOT_MIN = 1e-11

# A cell that cannot read below its floor (0, or the smallest count sent) has a mean reading above
# the true pressure. At a pressure z standard deviations above the floor, this excess is E[max(z +
# e, 0)] − z = E[max(e − z, 0)] with e ~ N(0, 1), in standard deviations. The excess is approximated
# to within 3e-4 by (1 − z/CLIP_END)² times this polynomial. Cells more than CLIP_BELOW below the
# floor carry almost no information.
CLIP_END = 3.5
CLIP_BELOW = 2.0
CLIP = (0.399207, -0.275277, 0.0188358, 0.0260713, -0.00538491)


@inner_kernel
def parameters(options: Options) -> tuple[int, int]:
    """Return the half-open range of the fitted parameters."""
    return GAIN if options.free_gain else DEPTH, PARAMETERS if options.is_solid else SHEAR_X


@fast_inner_kernel
def _set_model(gain: float, cells: Cells, first: int, last: int) -> None:
    for k in range(first, last):
        cells.model[k] = gain * cells.stress[k]


@fast_inner_kernel
def _add_shear(images: Images, x: float, y: float, cells: Cells, image: int, count: int) -> None:
    for k in range(index(0), count):
        cells.model[k] += x * images.pixels[image + k] + y * images.pixels[image + count + k]


@inner_kernel
def press(state: EstimatorState, model: Model, cells: Cells) -> tuple[int, int]:
    """Evaluate the model at the current contact; return the range of affected cells."""
    fit = state.fit
    if state.options.is_solid:
        images = model.images
        count = cells.stress.shape[0]
        weights = images.weights
        press_solid(weights, images.pixels, fit.d, fit.n_x, fit.n_y, cells.planes)
        _set_model(fit.gain, cells, index(0), index(count))
        shear = index(weights.images * count)
        _add_shear(images, fit.shear[0], fit.shear[1], cells, shear, index(count))
        return 0, count
    set_face(fit.face, state.grid.radius, fit.d, fit.n_x, fit.n_y)
    first, last = press_springs(model.points, state.grid, fit.face, state.around, cells.planes)
    first *= state.grid.cols
    last *= state.grid.cols
    _set_model(fit.gain, cells, index(first), index(last))
    return first, last


@fast_inner_kernel
def _energy_inside(frame: FloatArray, cells: Cells, first: int, last: int) -> tuple[float, float]:
    """Return Σ p² over the cells that the model presses, and their number."""
    energy = 0.0
    number = 0.0
    for k in range(first, last):
        inside = (cells.stress[k] != 0.0) & (cells.height[k] >= 0.0)
        energy += frame[k] * frame[k] if inside else 0.0
        number += 1.0 if inside else 0.0
    return energy, number


@inner_kernel
def free_noise(square: float, floor: float) -> float:
    """Return a cell's noise σ [Pa] from the mean ``square`` [Pa²] of unloaded cells.

    Unloaded cells read 0 below ``floor`` [Pa], so E[y²] = σ²(τ φ(τ) + Q(τ)) with τ = floor/σ. For a
    floor of 0, E[y²] is half the variance. If all cells read below the floor, the result is
    slightly less than a third of the floor.
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


@inner_kernel
def squared_sum(state: EstimatorState) -> float:
    """Return Σ p² [Pa²] over all cells."""
    energy: float = state.signal.energy * state.signal.scale * state.signal.scale
    return energy


@inner_kernel
def _clip_noise(
    state: EstimatorState, frame: FloatArray, cells: Cells, first: int, last: int
) -> float:
    """Use the unloaded cells to estimate the noise [Pa] of cells clipped at the floor.

    If the unloaded cells do not show noise, a correction is not needed.
    """
    signal = state.signal
    inside, inside_number = _energy_inside(frame, cells, index(first), index(last))
    clip = math.sqrt(signal.variance)
    number = float(signal.number) - inside_number
    if number >= 16.0:
        free_square = max(squared_sum(state) - inside * signal.scale * signal.scale, 0.0) / number
        clip = min(clip, free_noise(free_square, signal.floor))
    return clip


@fast_inner_kernel
def compare(state: EstimatorState, frame: FloatArray, cells: Cells, first: int, last: int) -> None:
    """Compute ``residual`` and ``factor`` of each cell, and their sums, from readings and model.

    A cell never reads below the floor, and never below 0 even where the rubber is in tension. A
    saturated cell is used only if the model is below saturation. If ``fit.clip_noise`` > 0, the
    noise is clipped at the floor; otherwise, cells with a model below the floor are excluded.
    """
    fit = state.fit
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
        model = cells.model[k]
        pressure = max(model, 0.0)
        response = 1.0 if model > 0.0 else 0.0
        reading = max(raw, floor)
        residual = reading - pressure
        if clipped:
            # The excess above max(pressure, floor) is symmetric about the floor.
            depth = (pressure - floor) * per_clip
            z = min(abs(depth), CLIP_END)
            above = 1.0 - z * (1.0 / CLIP_END)
            base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
            rise = CLIP[1] + z * (2.0 * CLIP[2] + z * (3.0 * CLIP[3] + z * 4.0 * CLIP[4]))
            rise = above * (above * rise - (2.0 / CLIP_END) * base)
            residual = reading - max(pressure, floor) - clip * above * above * base
            response *= 1.0 + rise if depth >= 0.0 else -rise
        inside = (cells.stress[k] != 0.0) & (cells.height[k] >= 0.0)
        counts = inside & ((raw < saturation) | (model < saturation)) & (pressure >= lower)
        residual = residual if counts else 0.0
        cells.residual[k] = residual
        cells.factor[k] = response if counts else 0.0
        misfit += residual * residual
        readings += raw * raw if inside else 0.0
        weight += 1.0 if counts else 0.0
    fit.misfit = misfit
    fit.readings = readings
    fit.counted_cells = weight


@fast_inner_kernel
def _accumulate(fit: Fit, cells: Cells, first: int, last: int) -> None:
    """Compute JᵀJ and Jᵀr over the cells for the gain, d and the tilts."""
    gain = fit.gain
    s00 = s01 = s02 = s03 = s11 = s12 = s13 = s22 = s23 = s33 = 0.0
    r0 = r1 = r2 = r3 = 0.0
    for k in range(first, last):
        factor = cells.factor[k]
        residual = cells.residual[k]
        a0 = factor * cells.stress[k]
        a1 = factor * cells.by_d[k]
        a2 = factor * cells.by_x[k]
        a3 = factor * cells.by_y[k]
        s00 += a0 * a0
        s01 += a0 * a1
        s02 += a0 * a2
        s03 += a0 * a3
        s11 += a1 * a1
        s12 += a1 * a2
        s13 += a1 * a3
        s22 += a2 * a2
        s23 += a2 * a3
        s33 += a3 * a3
        r0 += a0 * residual
        r1 += a1 * residual
        r2 += a2 * residual
        r3 += a3 * residual
    g2 = gain * gain
    fit.gradient[0], fit.gradient[1] = r0, gain * r1
    fit.gradient[2], fit.gradient[3] = gain * r2, gain * r3
    fit.normal[0, 0], fit.normal[1, 0], fit.normal[2, 0] = s00, gain * s01, gain * s02
    fit.normal[3, 0], fit.normal[1, 1], fit.normal[2, 1] = gain * s03, g2 * s11, g2 * s12
    fit.normal[3, 1], fit.normal[2, 2], fit.normal[3, 2] = g2 * s13, g2 * s22, g2 * s23
    fit.normal[3, 3] = g2 * s33


@fast_inner_kernel
def _accumulate_shear(
    fit: Fit, images: Images, cells: Cells, row: int, first: int, second: int
) -> None:
    """Compute the entries of the normal equations for the shear image that starts at ``first``."""
    t0 = t1 = t2 = t3 = own = other = right = 0.0
    for k in range(index(0), index(cells.factor.shape[0])):
        factor = cells.factor[k]
        image = factor * images.pixels[first + k]
        along = factor * image
        t0 += along * cells.stress[k]
        t1 += along * cells.by_d[k]
        t2 += along * cells.by_x[k]
        t3 += along * cells.by_y[k]
        own += image * image
        other += along * images.pixels[second + k]
        right += image * cells.residual[k]
    gain = fit.gain
    normal = fit.normal
    normal[row, 0], normal[row, 1], normal[row, 2] = t0, gain * t1, gain * t2
    normal[row, 3], normal[row, row] = gain * t3, own
    normal[SHEAR_Y, SHEAR_X] = other
    fit.gradient[row] = right


@inner_kernel
def linearise(state: EstimatorState, model: Model, frame: FloatArray, cells: Cells) -> float:
    """Set up the normal equations at the current contact; return the cost [Pa²] minus Σ reading².

    The shear force has a prior whose standard deviation is proportional to the normal force.
    """
    fit = state.fit
    images = model.images
    first, last = press(state, model, cells)
    fit.first_row = first // state.grid.cols
    fit.last_row = last // state.grid.cols
    fit.clip_noise = 0.0
    if state.signal.is_clipped:
        fit.clip_noise = _clip_noise(state, frame, cells, first, last)
    compare(state, frame, cells, index(first), index(last))
    _accumulate(fit, cells, index(first), index(last))
    cost: float = fit.misfit - fit.readings
    if state.options.is_solid:
        weights = images.weights
        one = index(weights.images * last)
        two = index((weights.images + 1) * last)
        _accumulate_shear(fit, images, cells, SHEAR_X, one, two)
        _accumulate_shear(fit, images, cells, SHEAR_Y, two, one)
        likely = state.options.shear_prior * max(fit.gain * weights.value[0], 1e-9)
        prior = state.signal.variance / (likely * likely)
        for k in range(2):
            fit.normal[SHEAR_X + k, SHEAR_X + k] += prior
            fit.gradient[SHEAR_X + k] -= prior * fit.shear[k]
            cost += prior * fit.shear[k] * fit.shear[k]
    return cost


@inner_kernel
def solve(fit: Fit, first: int, last: int) -> bool:
    """Solve the normal equations for parameters first to last; set step, inverse and decrement.

    Returns False if a pivot of the scaled matrix is too small, i.e. if the frame does not determine
    all parameters.
    """
    normal = fit.normal
    lower = fit.lower
    scale = fit.scale
    for i in range(first, last):
        if not normal[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(normal[i, i])
    # Compute the Cholesky factor, and store its inverse in place.
    for j in range(first, last):
        pivot = 1.0
        for k in range(first, j):
            pivot -= lower[j, k] * lower[j, k]
        if not pivot > _PIVOT_MIN:
            return False
        lower[j, j] = math.sqrt(pivot)
        for i in range(j + 1, last):
            value = normal[i, j] * scale[i] * scale[j]
            for k in range(first, j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = value / lower[j, j]
    for j in range(first, last):
        lower[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, last):
            value = 0.0
            for k in range(j, i):
                value -= lower[i, k] * lower[k, j]
            lower[i, j] = value / lower[i, i]
    fit.inverse[:] = 0.0
    fit.step[:] = 0.0
    fit.decrement = 0.0
    for i in range(first, last):
        for j in range(first, last):
            value = 0.0
            for k in range(max(i, j), last):
                value += lower[k, i] * lower[k, j]
            fit.inverse[i, j] = value * scale[i] * scale[j]
            fit.step[i] += fit.inverse[i, j] * fit.gradient[j]
        fit.decrement += fit.step[i] * fit.gradient[i]
    return math.isfinite(fit.decrement)


@inner_kernel
def _apply_step(state: EstimatorState) -> bool:
    """Apply the step, clamped to the model's limits; return False if d was clamped."""
    fit = state.fit
    options = state.options
    shallow = fit.d
    fit.gain = max(fit.gain + fit.step[GAIN], 0.2 * fit.gain)
    fit.n_x += fit.step[TILT_X]
    fit.n_y += fit.step[TILT_Y]
    fit.shear[0] += fit.step[SHEAR_X]
    fit.shear[1] += fit.step[SHEAR_Y]
    tilt = math.hypot(fit.n_x, fit.n_y)
    fit.is_limited = tilt > options.step_sine
    if fit.is_limited:
        fit.n_x *= options.step_sine / tilt
        fit.n_y *= options.step_sine / tilt
    d = fit.d + fit.step[DEPTH]
    fit.is_limited = fit.is_limited or d > options.step_deepest
    fit.d = min(max(d, 0.3 * shallow, 1e-4 * state.grid.radius), options.step_deepest)
    return bool(d == fit.d)


@inner_kernel
def set_covariance(inverse: Normal, variance: float, out: Matrix) -> None:
    """Set the covariance of (d, n_x, n_y, gain) from the covariance of the fit parameters."""
    for i in range(4):
        for j in range(4):
            out[(i + 3) % 4, (j + 3) % 4] = variance * inverse[i, j]


@inner_kernel
def _check_fit(state: EstimatorState, model: Model, cells: Cells) -> float:
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
        estimate.shared = math.sqrt(budget.shared[DEPTH, DEPTH]) / fit.d
    beyond = misfit - expected - variance * freedom
    if beyond > variance * math.sqrt(2.0 * max(freedom, 0.0)):
        undetected = undetected_misfit(state, cells, beyond)
        estimate.undetected = math.sqrt(undetected * fit.inverse[DEPTH, DEPTH]) / fit.d
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                budget.shared[i, j] += undetected * fit.inverse[i, j]
    if budget.is_correlated:
        freedom = fit.counted_cells - widen_covariance(state) - (last - first - 4.0)
    freedom = max(freedom, 1.0)
    estimate.chi2 = misfit / (variance * freedom + expected)
    excess = max(estimate.chi2 - 3.0 * math.sqrt(2.0 * budget.cells_per_sample / freedom), 1.0)
    return variance * excess if fit.counted_cells > 4.0 else -1.0


@inner_kernel
def _finish(state: EstimatorState, model: Model, cells: Cells, iterations: int) -> bool:
    """Set the estimate and its covariance after the fit; return False for too few cells."""
    fit = state.fit
    estimate = state.estimate
    options = state.options
    square = fit.n_x * fit.n_x + fit.n_y * fit.n_y
    if options.is_solid:
        area = state.grid.radius * state.grid.radius
        along = area * math.cos(options.rotation)
        across = area * math.sin(options.rotation)
        own = fit.gain * own_shear(model.images.weights, fit.d, square)
        x = fit.shear[0] + own * fit.n_x
        y = fit.shear[1] + own * fit.n_y
        estimate.shear_x = along * x - across * y
        estimate.shear_y = across * x + along * y
    # Clamp the result, because noise may push the fit beyond the limits of the model.
    within = min(1.0, options.sine_max / max(math.sqrt(square), 1e-9))
    estimate.d = min(fit.d, options.deepest)
    estimate.n_x = within * fit.n_x
    estimate.n_y = within * fit.n_y
    estimate.gain = fit.gain
    estimate.shear[:] = fit.shear
    estimate.iterations = iterations
    variance = _check_fit(state, model, cells)
    wider = 1.0
    if options.free_gain:
        # The larger the uncertainty of d, the less linear is the relation between d and the gain.
        uncertain = variance * fit.inverse[DEPTH, DEPTH] + state.budget.shared[DEPTH, DEPTH]
        wider += _GAIN_CURVATURE * min(uncertain / (fit.d * fit.d), 1.0)
    set_covariance(fit.inverse, wider * variance, fit.covariance)
    set_covariance(state.budget.shared, wider, state.budget.covariance)
    return bool(variance > 0.0)


@inner_kernel
def fit(
    state: EstimatorState, model: Model, frame: FloatArray, cells: Cells, tolerance: float
) -> bool:
    """Run the Gauss-Newton method from the contact in ``state.estimate``; store the result there.

    The iteration stops if the predicted decrement is below ``tolerance`` · variance, where
    ``tolerance`` is the squared ratio of the step to the noise floor. Returns False if the frame
    does not determine the contact, if the iteration does not converge, or if the contact is beyond
    the limits of the model.
    """
    fit = state.fit
    estimate = state.estimate
    variance = state.signal.variance
    first, last = parameters(state.options)
    fit.d = min(estimate.d, state.options.deepest)
    fit.n_x = estimate.n_x
    fit.n_y = estimate.n_y
    fit.gain = estimate.gain
    fit.shear[:] = estimate.shear
    d = n_x = n_y = gain = shear_x = shear_y = 0.0  # parameter values before the last step
    before = math.inf
    halvings = 0
    limited = 0
    solved = False
    for iteration in range(state.options.iterations):
        cost = linearise(state, model, frame, cells)
        if solved and not cost <= before + variance and halvings < _HALVINGS_MAX:
            # The cost has increased, so halve the step.
            fit.d = 0.5 * (fit.d + d)
            fit.n_x = 0.5 * (fit.n_x + n_x)
            fit.n_y = 0.5 * (fit.n_y + n_y)
            fit.gain = 0.5 * (fit.gain + gain)
            fit.shear[0] = 0.5 * (fit.shear[0] + shear_x)
            fit.shear[1] = 0.5 * (fit.shear[1] + shear_y)
            halvings += 1
            continue
        before = cost
        solved = solve(fit, first, last)
        if not solved:
            return False
        d = fit.d
        n_x = fit.n_x
        n_y = fit.n_y
        gain = fit.gain
        shear_x = fit.shear[0]
        shear_y = fit.shear[1]
        halvings = 0
        kept = not _apply_step(state)
        limited = limited + 1 if fit.is_limited else 0
        if limited == _LIMITED_MAX:
            return False
        if fit.decrement <= tolerance * variance and not kept:
            return _finish(state, model, cells, iteration + 1)
    return False
