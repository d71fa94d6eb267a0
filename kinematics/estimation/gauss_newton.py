"""Gauss-Newton on the likelihood of one pressure frame, as kernels.

Holds the solution of the normal equations, the iteration with its stopping rule, and the covariance
of what comes out. Parameters are (gain, u, v, w) inside and (d, n_x, n_y, gain) outside; see
footprint.py for (u, v, w).
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd_sums import LANES
from softfinger.kinematics.estimation.blurred_cells import spread
from softfinger.kinematics.estimation.cut_cells import LEVELS, OWNERS, PLANES, STRIP_ROWS, STRIPS
from softfinger.kinematics.estimation.likelihood import accumulate, footprint_energy, is_bent, press
from softfinger.kinematics.estimation.packing import pack
from softfinger.kinematics.estimation.scratch import (
    GRID,
    INTEGERS,
    INVERSE,
    OWNED,
    PARTS_X,
    PARTS_Y,
    QUEUES,
    SPREAD_X,
    SPREAD_Y,
    STEP,
    SUMS,
    WEIGHTS_X,
    WEIGHTS_Y,
    WORK,
)
from softfinger.kinematics.sensing.cell_integrals import CELL_PLANES
from softfinger.kinematics.sensing.footprint import FloatArray, Geometry, IntArray, plane

# Places in what a fit leaves in ``result``.
D, N_X, N_Y, GAIN, CHI2, CELLS, ITERATIONS, RESIDUAL = range(8)
RESULT = 8
# Of the covariance with the gain free, in (σ_d/d)²: measured over the envelope, where the errors'
# square over what a straight model gives rises so.
GAIN_CURVATURE = 6.0


@inner_kernel
def solve(
    sums: FloatArray,
    gain: float,
    free: bool,
    step: FloatArray,
    inverse: FloatArray,
    work: FloatArray,
) -> tuple[bool, float]:
    """Gauss-Newton step in (gain, u, v, w), the inverse normal matrix, (solvable, decrement).

    ``sums`` are :func:`estimation.likelihood.accumulate`'s. Without a ``free`` gain its row is left
    out. The decrement is the fall of the sum of squares that the step promises. Not solvable where
    a pivot of the scaled matrix is below 1e-11: the frame doesn't determine every parameter.
    ``work`` [40] is scratch.
    """
    first = 0 if free else 1
    matrix = work[:16].reshape(4, 4)
    lower = work[16:32].reshape(4, 4)
    right = work[32:36]
    scale = work[36:40]
    factor = (1.0, -gain, gain, gain)
    k = 0
    for i in range(4):
        for j in range(i, 4):
            matrix[j, i] = sums[k] * factor[i] * factor[j]
            k += 1
        right[i] = sums[10 + i] * factor[i]
    for i in range(first, 4):
        if not matrix[i, i] > 0.0:
            return False, 0.0
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(first, 4):
        for j in range(first, i + 1):
            matrix[i, j] *= scale[i] * scale[j]
    # Cholesky in the lower triangle, its inverse in ``lower``.
    lower[:] = 0.0
    for j in range(first, 4):
        pivot = matrix[j, j]
        for k in range(first, j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 1e-11:
            return False, 0.0
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
    return math.isfinite(decrement), decrement


@inner_kernel
def covariance_of(
    inverse: FloatArray, a: float, u: float, v: float, w: float, variance: float, out: FloatArray
) -> None:
    """Covariance of (d, n_x, n_y, gain), rows after another in ``out`` [16].

    ``inverse`` is that of the normal matrix in (gain, u, v, w), ``variance`` a cell's.
    """
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
            out[4 * i + j] = (by_u * x + by_v * y + by_w * z) * variance
        out[4 * i + 3] = by_gain * variance
        out[12 + i] = by_gain * variance
    out[15] = inverse[0, 0] * variance


@inner_kernel
def free_noise(square: float, floor: float) -> float:
    """A cell's noise [Pa] from the mean ``square`` [Pa²] of cells that nothing presses.

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
        share = tau * math.exp(-0.5 * tau * tau) / math.sqrt(2.0 * math.pi)
        share += 0.5 * math.erfc(tau / math.sqrt(2.0))
        if share > target * tau * tau:
            low = tau
        else:
            high = tau
    return 2.0 * floor / (low + high)


@inner_kernel
def fit(
    frame: FloatArray,
    scale: float,
    geometry: Geometry,
    cells: FloatArray,
    law: FloatArray,
    free: bool,
    saturation: float,
    floor: float,
    clipped: bool,
    energy: float,
    number: float,
    variance: float,
    tolerance: float,
    iterations: int,
    floats: FloatArray,
    integers: IntArray,
    result: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Gauss-Newton from the contact in ``result`` (D, N_X, N_Y, GAIN), the estimate left there.

    ``variance`` [Pa²] is a cell's, ``saturation`` [Pa] its end;
    ``floor`` as for :func:`estimation.likelihood.accumulate`;
    ``clipped``: none reads below the floor. ``energy`` and ``number`` are Σ p² [Pa²] and the number
    of the live cells in the tip's disc. Stops when the promised decrement
    is below ``tolerance`` · variance, that is the step is that part of the noise floor, squared.
    ``floats`` and ``integers`` are scratch, see workspace.py.
    RESIDUAL takes Σ over the footprint of (reading − model)² − reading² [Pa²]. False when the
    frame doesn't determine the contact or the iteration doesn't settle.
    """
    a = geometry[0]
    rows, cols = frame.shape
    sums = floats[SUMS:STEP]
    step = floats[STEP:INVERSE]
    inverse = floats[INVERSE:WORK].reshape(4, 4)
    work = floats[WORK:GRID]
    # With a blur the parts of cells are modelled, and more of them than the sensor has.
    places = integers[INTEGERS:]
    blurred = places.shape[0] > 0
    parts_x = integers[PARTS_X]
    parts_y = integers[PARTS_Y]
    high = rows * parts_y + 2 * integers[SPREAD_Y]
    wide = cols * parts_x + 2 * integers[SPREAD_X]
    size = high * wide
    at = GRID
    columns = floats[at : at + 2 * (wide + 1)].reshape(2, wide + 1)
    at += 2 * (wide + 1)
    lines = floats[at : at + 2 * (high + 1)].reshape(2, high + 1)
    at += 2 * (high + 1)
    strips = floats[at : at + LEVELS * STRIP_ROWS * STRIPS].reshape(LEVELS, STRIP_ROWS, STRIPS)
    at += LEVELS * STRIP_ROWS * STRIPS
    packed = floats[at : at + PLANES * size].reshape(PLANES, size)
    at += PLANES * size
    queues = integers[QUEUES:OWNED].reshape(LEVELS, 2)
    owners = integers[OWNED:INTEGERS].reshape(LEVELS, 2, OWNERS)
    modelled = geometry
    readings = frame
    planes = cells
    along = half = floats[at:at]
    across = fine = floats[at:at].reshape(0, 0)
    if blurred:
        pitch_x = geometry[3] / parts_x
        pitch_y = geometry[4] / parts_y
        modelled = (
            a,
            geometry[1] - integers[SPREAD_X] * pitch_x,
            geometry[2] - integers[SPREAD_Y] * pitch_y,
            pitch_x,
            pitch_y,
        )
        n_x = integers[WEIGHTS_X]
        n_y = integers[WEIGHTS_Y]
        across = floats[at : at + n_x].reshape(parts_x, n_x // parts_x)
        at += n_x
        along = floats[at : at + n_y]
        at += n_y
        planes = floats[at : at + CELL_PLANES * size].reshape(high, CELL_PLANES, wide)
        at += CELL_PLANES * size
        padded = parts_x * (cols + 2 * LANES) + n_x
        fine = floats[at : at + (high + 1) * padded].reshape(high + 1, padded)
        # Parts have no readings of their own; what stands here is not used.
        readings = floats[at : at + size].reshape(high, wide)
        at += (high + 1) * padded
        half = floats[at : at + padded]
    bent = is_bent(law)
    u, v, w = plane(a, result[D], result[N_X], result[N_Y])
    gain = result[GAIN]
    cost = math.inf
    before = (u, v, w, gain)
    halvings = 0
    solved = False
    for iteration in range(iterations):
        count = pack(
            u,
            v,
            w,
            modelled,
            planes,
            readings,
            scale,
            bent,
            columns,
            lines,
            strips,
            queues,
            owners,
            packed,
            places,
        )
        press(packed, count, u, v, w, law)
        if blurred:
            count = spread(
                packed,
                count,
                places,
                frame,
                scale,
                cells,
                across,
                along,
                parts_y,
                fine,
                half,
            )
        clip = 0.0
        if clipped:
            # Free cells show how much of the noise there is; where a board sends none at all
            # there is nothing to correct.
            inside, inside_number = footprint_energy(packed, count)
            clip = math.sqrt(variance)
            if number - inside_number >= 16.0:
                free_square = max(energy - inside, 0.0) / (number - inside_number)
                clip = min(clip, free_noise(free_square, floor))
        accumulate(packed, count, gain, saturation, floor, clip, sums)
        now = sums[14] - sums[15]
        if solved and not now <= cost + variance and halvings < 5:
            # Too far: half way back.
            u = 0.5 * (u + before[0])
            v = 0.5 * (v + before[1])
            w = 0.5 * (w + before[2])
            gain = 0.5 * (gain + before[3])
            halvings += 1
            continue
        cost = now
        solved, decrement = solve(sums, gain, free, step, inverse, work)
        if not solved:
            return False
        before = (u, v, w, gain)
        halvings = 0
        gain = max(gain + step[0], 0.2 * gain)
        u += step[1]
        v += step[2]
        w += step[3]
        # Keep the face between the tip's top and its base plate.
        tilt = math.hypot(v, w)
        if tilt > 3.0:
            v *= 3.0 / tilt
            w *= 3.0 / tilt
        n_z = 1.0 / math.sqrt(1.0 + v * v + w * w)
        d = a - u * n_z
        shallow = a - before[0] / math.sqrt(1.0 + before[1] ** 2 + before[2] ** 2)
        limited = min(max(d, 0.3 * shallow, 1e-4 * a), 0.95 * a)
        if limited != d:
            u = (a - limited) / n_z
        elif decrement <= tolerance * variance:
            freedom = sums[16] - (4.0 if free else 3.0)
            misfit = max(sums[14] - decrement, 0.0)
            result[D] = d
            result[N_X] = v * n_z
            result[N_Y] = w * n_z
            result[GAIN] = gain
            result[CHI2] = misfit / (variance * max(freedom, 1.0))
            result[CELLS] = sums[16]
            result[ITERATIONS] = iteration + 1
            result[RESIDUAL] = misfit - sums[15]
            # A misfit beyond its own scatter widens the covariance.
            excess = max(result[CHI2] - 3.0 * math.sqrt(2.0 / max(freedom, 1.0)), 1.0)
            covariance_of(inverse, a, u, v, w, variance * excess, covariance)
            if free:
                # The more d is uncertain, the less straight it is in the gain.
                wider = 1.0 + GAIN_CURVATURE * min(covariance[0] / (d * d), 1.0)
                for k in range(16):
                    covariance[k] *= wider
            return bool(freedom > 0.0)
    return False
