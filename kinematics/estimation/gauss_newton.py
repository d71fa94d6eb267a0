"""Gauss-Newton on the likelihood of one pressure frame, as kernels.

The solution of the normal equations, the iteration with its stopping rule, and the covariance of
what comes out. Parameters are (gain, u, v, w) inside and (d, n_x, n_y, gain) outside; see
footprint.py for (u, v, w).
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address, further
from softfinger.kinematics.estimation.blurred_cells import blur_cells
from softfinger.kinematics.estimation.error_budget import correlate, systematic, undetected_misfit
from softfinger.kinematics.estimation.likelihood import accumulate, compress, footprint_energy
from softfinger.kinematics.estimation.packing import pack
from softfinger.kinematics.estimation.solid_projection import SolidFit
from softfinger.kinematics.estimation.state import EstimatorState, Fit, Matrix
from softfinger.kinematics.sensing.footprint import IntArray, set_face

# Of the covariance with the gain free, in (σ_d/d)²: measured over the envelope, where the errors'
# square over what a straight model gives rises so.
GAIN_CURVATURE = 6.0
_HALVINGS_MAX = 5
# tan of the largest tilt of the face that the iteration goes to, 71.57°: beyond it the footprint of
# any d that matters has left the tip, and a step there would not come back.
TAN_TILT_MAX = 3.0


@inner_kernel
def solve(fit: Fit, free: bool) -> bool:
    """Return the step in (gain, u, v, w), the inverse normal matrix and the decrement.

    Without a ``free`` gain its row is left out. False where a pivot of the scaled matrix is below
    1e-11: the frame doesn't determine every parameter.
    """
    first = 0 if free else 1
    matrix = fit.matrix
    lower = fit.lower
    right = fit.right
    scale = fit.scale
    gain = fit.gain
    factor = (1.0, -gain, gain, gain)
    k = 0
    for i in range(4):
        for j in range(i, 4):
            matrix[j, i] = fit.sums.normal[k] * factor[i] * factor[j]
            k += 1
        right[i] = fit.sums.right[i] * factor[i]
    for i in range(first, 4):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(first, 4):
        for j in range(first, i + 1):
            matrix[i, j] *= scale[i] * scale[j]
    # Cholesky in the lower triangle, its inverse in ``lower``.
    for j in range(first, 4):
        pivot = matrix[j, j]
        for k in range(first, j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 1e-11:
            return False
        pivot = math.sqrt(pivot)
        matrix[j, j] = pivot
        lower[j, j] = 1.0 / pivot
        for i in range(j + 1, 4):
            value = matrix[i, j]
            for k in range(first, j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / pivot
    for j in range(first, 4):
        for i in range(j + 1, 4):
            value = 0.0
            for k in range(j, i):
                value -= matrix[i, k] * lower[k, j]
            lower[i, j] = value * lower[i, i]
    inverse = fit.inverse
    step = fit.step
    inverse[:] = 0.0
    step[:] = 0.0
    decrement = 0.0
    for i in range(first, 4):
        for j in range(first, 4):
            value = 0.0
            for k in range(max(i, j), 4):
                value += lower[k, i] * lower[k, j]
            inverse[i, j] = value * scale[i] * scale[j]
            step[i] += inverse[i, j] * right[j]
        decrement += step[i] * right[i]
    fit.decrement = decrement
    return math.isfinite(decrement)


@inner_kernel
def set_covariance(
    solid: SolidFit | None, fit: Fit, inverse: Matrix, variance: float, out: Matrix
) -> None:
    """Transform the covariance of (gain, u, v, w) over variance to (d, n_x, n_y, gain)."""
    u = fit.face.u
    v = fit.face.v
    w = fit.face.w
    n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
    cube = n_z * n_z * n_z
    # d = a − u n_z, n_x = v n_z, n_y = w n_z, ∂n_z/∂v = −v n_z³. Rows by (u, v, w).
    rows = (
        (-n_z, u * v * cube, u * w * cube),
        (0.0, n_z - v * v * cube, -v * w * cube),
        (0.0, -v * w * cube, n_z - w * w * cube),
    )
    for i in range(3):
        p, q, r = rows[i]
        # One row of the Jacobian times the matrix.
        by_gain = p * inverse[1, 0] + q * inverse[2, 0] + r * inverse[3, 0]
        by_u = p * inverse[1, 1] + q * inverse[2, 1] + r * inverse[3, 1]
        by_v = p * inverse[1, 2] + q * inverse[2, 2] + r * inverse[3, 2]
        by_w = p * inverse[1, 3] + q * inverse[2, 3] + r * inverse[3, 3]
        for j in range(3):
            x, y, z = rows[j]
            out[i, j] = (by_u * x + by_v * y + by_w * z) * variance
        out[i, 3] = by_gain * variance
        out[3, i] = by_gain * variance
    out[3, 3] = inverse[0, 0] * variance


@inner_kernel
def free_noise(square: float, floor: float) -> float:
    """Return a cell's noise [Pa] from the mean ``square`` [Pa²] of cells that nothing presses.

    They read it from ``floor`` [Pa] on and 0 below, so E[y²] = σ²(τ φ(τ) + Q(τ)) with τ = floor/σ:
    half of the variance without a floor. Where none is above it the noise is below a third of it.
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
def energy_of(state: EstimatorState) -> float:
    """Return Σ p² [Pa²] of the cells in the region."""
    energy: float = state.signal.energy * state.signal.scale * state.signal.scale
    return energy


@inner_kernel
def _clip_noise(state: EstimatorState, packed: Pointer) -> float:
    """Noise [Pa] of the cells that end at the floor, by those that nothing presses.

    These show how much of the noise there is; where a board sends none at all there is nothing to
    correct.
    """
    inside, inside_number = footprint_energy(state, packed)
    clip = math.sqrt(state.signal.variance)
    number = float(state.region.number)
    if number - inside_number >= 16.0:
        free_square = max(energy_of(state) - inside, 0.0) / (number - inside_number)
        clip = min(clip, free_noise(free_square, state.signal.floor))
    return clip


@inner_kernel
def _apply_step(fit: Fit, a: float) -> bool:
    """Go on by the step, the face kept between the tip's top and its base plate; False if kept."""
    face = fit.face
    shallow = a - face.u / math.sqrt(1.0 + face.v**2 + face.w**2)
    fit.gain = max(fit.gain + fit.step[0], 0.2 * fit.gain)
    u = face.u + fit.step[1]
    v = face.v + fit.step[2]
    w = face.w + fit.step[3]
    tilt = math.hypot(v, w)
    if tilt > TAN_TILT_MAX:
        v *= TAN_TILT_MAX / tilt
        w *= TAN_TILT_MAX / tilt
    n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
    d = a - u * n_z
    limited = min(max(d, 0.3 * shallow, 1e-4 * a), 0.95 * a)
    face.u = u if limited == d else (a - limited) / n_z
    face.v = v
    face.w = w
    return bool(limited == d)


@inner_kernel
def check_fit(solid: SolidFit | None, state: EstimatorState, packed: Pointer) -> float:
    """Compute χ² of the solved fit, and the covariance by shared errors and by a smooth misfit.

    The noise's variance [Pa²] is returned, widened by a misfit beyond its own scatter; after that
    ``fit.inverse`` is times it the covariance under the noise. Negative with too few cells.
    """
    fit = state.fit
    estimate = state.estimate
    budget = state.budget
    variance = state.signal.variance
    d = estimate.d
    freedom = fit.sums.weight - (4.0 if state.options.free_gain else 3.0)
    misfit = max(fit.sums.misfit - fit.decrement, 0.0)
    estimate.cells = int(fit.sums.weight)
    estimate.residual = misfit - fit.sums.readings
    expected = undetected = 0.0
    if budget.systematic:
        expected = systematic(solid, state, packed, d, budget.shared)
        set_covariance(solid, fit, budget.shared, 1.0, budget.covariance)
        estimate.shared = math.sqrt(budget.covariance[0, 0]) / d
    beyond = misfit - expected - variance * freedom
    if beyond > variance * math.sqrt(2.0 * max(freedom, 0.0)):
        undetected = undetected_misfit(solid, state, packed, beyond)
    if undetected > 0.0:
        if not budget.systematic:
            budget.shared[:] = 0.0
        for i in range(4):
            for j in range(4):
                budget.shared[i, j] += undetected * fit.inverse[i, j]
        set_covariance(solid, fit, fit.inverse, undetected, budget.covariance)
        estimate.undetected = math.sqrt(budget.covariance[0, 0]) / d
        set_covariance(solid, fit, budget.shared, 1.0, budget.covariance)
    if budget.correlated:
        freedom = fit.sums.weight - correlate(solid, state, d)
    freedom = max(freedom, 1.0)
    estimate.chi2 = misfit / (variance * freedom + expected)
    excess = max(estimate.chi2 - 3.0 * math.sqrt(2.0 * budget.cells_per_sample / freedom), 1.0)
    return variance * excess if fit.sums.weight > 4.0 else -1.0


@inner_kernel
def _finish(state: EstimatorState, packed: Pointer, iterations: int) -> bool:
    """The estimate and its covariance at the fit's end; whether there are cells enough."""
    fit = state.fit
    estimate = state.estimate
    v = fit.face.v
    w = fit.face.w
    n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
    estimate.d = state.grid.radius - fit.face.u * n_z
    estimate.n_x = v * n_z
    estimate.n_y = w * n_z
    return conclude(None, state, packed, iterations)


@inner_kernel
def conclude(
    solid: SolidFit | None, state: EstimatorState, packed: Pointer, iterations: int
) -> bool:
    """Return the covariance and χ² at the fit's end; whether there are cells enough."""
    fit = state.fit
    estimate = state.estimate
    estimate.gain = fit.gain
    estimate.iterations = iterations
    variance = check_fit(solid, state, packed)
    set_covariance(solid, fit, fit.inverse, variance, fit.covariance)
    if state.options.free_gain:
        # The more d is uncertain, the less straight it is in the gain.
        covariance = fit.covariance
        shared = state.budget.covariance
        uncertain = (covariance[0, 0] + shared[0, 0]) / (estimate.d * estimate.d)
        wider = 1.0 + GAIN_CURVATURE * min(uncertain, 1.0)
        for i in range(4):
            for j in range(4):
                covariance[i, j] *= wider
                shared[i, j] *= wider
    return bool(variance > 0.0)


@inner_kernel
def linearise(
    state: EstimatorState, frame: Pointer, scratch: Pointer, indices: IntArray | None
) -> None:
    """Pack the cells of the fit's face, press them, and sum up the normal equations."""
    packed = further(scratch, state.at.packed)
    if indices is None:
        pack(state, further(scratch, state.at.cells), frame, scratch, None)
    else:
        # Parts have no readings of their own; those taken from ``fine`` are not used.
        pieces = further(scratch, state.at.pieces)
        pack(state, pieces, further(scratch, state.at.fine), scratch, address(indices))
    compress(state, packed)
    if indices is not None:
        blur_cells(state, frame, scratch, address(indices))
    state.fit.clip = _clip_noise(state, packed) if state.signal.clipped else 0.0
    accumulate(state, packed)


@inner_kernel
def fit(
    solid: SolidFit | None,
    state: EstimatorState,
    frame: Pointer,
    scratch: Pointer,
    indices: IntArray | None,
    tolerance: float,
) -> bool:
    """Run Gauss-Newton from the contact in ``state.estimate`` and leave the new estimate there.

    Stops when the promised decrement is below ``tolerance`` · variance, that is the step is that
    part of the noise floor, squared. False when the frame doesn't determine the contact or the
    iteration doesn't settle.
    """
    fit = state.fit
    face = fit.face
    a = state.grid.radius
    variance = state.signal.variance
    packed = further(scratch, state.at.packed)
    set_face(face, a, state.estimate.d, state.estimate.n_x, state.estimate.n_y)
    fit.gain = state.estimate.gain
    u = v = w = gain = 0.0  # before the last step
    cost = math.inf
    halvings = 0
    solved = False
    for iteration in range(state.options.iterations):
        linearise(state, frame, scratch, indices)
        now = fit.sums.misfit - fit.sums.readings
        if solved and not now <= cost + variance and halvings < _HALVINGS_MAX:
            # Too far: half way back.
            face.u = 0.5 * (face.u + u)
            face.v = 0.5 * (face.v + v)
            face.w = 0.5 * (face.w + w)
            fit.gain = 0.5 * (fit.gain + gain)
            halvings += 1
            continue
        cost = now
        solved = solve(fit, state.options.free_gain)
        if not solved:
            return False
        u = face.u
        v = face.v
        w = face.w
        gain = fit.gain
        halvings = 0
        if _apply_step(fit, a) and fit.decrement <= tolerance * variance:
            return _finish(state, packed, iteration + 1)
    return False
