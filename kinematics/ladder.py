"""The estimator's one compiled entry: one pressure frame up the ladder.

Holds the order of the steps for a frame and the layout of the arrays that go in and out: activity
test, hot cells, then moments or maximum likelihood, from the last estimate or from the frame alone.
"""

from __future__ import annotations

import math

import numpy as np

from kinematics import gauss_newton
from kinematics.activity import activity, is_spike, presses_outside
from kinematics.cells import LIVE
from kinematics.cut_cells import LINE_ROWS, LINES, OWNERS, PLANES
from kinematics.footprint import FloatArray, IntArray
from kinematics.gauss_newton import RESULT, fit
from kinematics.kernels import fast_kernel, kernel
from kinematics.likelihood import SUMS
from kinematics.moments import RATIO_POINTS, coarse, coarse_weak, refine

# Places in the state: what a frame leaves, and where the next one starts. The estimate in the
# sensor's axes comes first, then what is told in the finger's.
(
    D,
    N_X,
    N_Y,
    GAIN,
    CHI2,
    CELLS,
    ITERATIONS,
    RESIDUAL,
    WARM,
    CONTACT,
    VALID,
    TILT_X,
    TILT_Y,
    EXPLAINED,
    PEAK,
    REJECTED,
    SECOND,
) = range(17)
TOLD = 17
COVARIANCE = TOLD  # 4 × 4 of (d, tilt_x, tilt_y, gain) in the finger's axes
STATE = COVARIANCE + 16

# Places in the options, after the five of the geometry.
(
    NOISE,
    SATURATION,
    FREE_GAIN,
    FIXED_GAIN,
    TOLERANCE,
    ITERATIONS_MAX,
    MOMENTS_ONLY,
    PEAK_LEVEL,
    PATCH_LEVEL,
    EXPLAINED_MIN,
    MODULUS,
    ROTATION,
    FLOOR,
) = range(5, 18)
OPTIONS = 18

WEAK = 15.0  # noise: a largest cell below is looked for together with its neighbours
SPIKES_MAX = 6  # hot cells left out of one frame
GAIN_MIN, GAIN_MAX = 0.05, 20.0  # outside it's not this tip on this sensor
D_MAX = 0.75  # of the radius


@fast_kernel
def _row_energy(row: FloatArray, live: FloatArray) -> tuple[float, float]:
    total = 0.0
    number = 0.0
    for j in range(row.shape[0]):
        value = row[j]
        mask = live[j]
        value = value if mask > 0.0 else 0.0
        total += value * value
        number += mask
    return total, number


@kernel
def _energy(frame: FloatArray, cells: FloatArray, runs: IntArray) -> tuple[float, float]:
    """Σ p² over the live cells in the tip's disc, and their number."""
    total = number = 0.0
    for i in range(frame.shape[0]):
        first = runs[i, 0]
        last = runs[i, 1]
        energy, live = _row_energy(frame[i, first:last], cells[i, LIVE, first:last])
        total += energy
        number += live
    return total, number


@kernel
def _start(
    frame: FloatArray,
    cells: FloatArray,
    runs: IntArray,
    ratios: FloatArray,
    plan: FloatArray,
    scale: float,
    noise: float,
    row: int,
    col: int,
    state: FloatArray,
    covariance: FloatArray,
) -> None:
    """First estimate from the frame alone, into ``state``."""
    geometry = (plan[0], plan[1], plan[2], plan[3], plan[4])
    peak = frame[row, col]
    if peak > WEAK * noise:
        level = max(4.0 * noise, 0.15 * peak)
        d, n_x, n_y = coarse(frame, cells, geometry, runs, level, row, col)
    else:
        level = 2.0 * noise
        patch = plan[PATCH_LEVEL] * noise
        d, n_x, n_y = coarse_weak(frame, cells, geometry, runs, level, patch, row, col)
    fixed = 0.0 if plan[FREE_GAIN] > 0.0 else plan[FIXED_GAIN]
    modulus = plan[MODULUS] / scale
    gain = 1.0
    for _ in range(2):
        d, n_x, n_y, gain = refine(
            frame, cells, geometry, ratios, modulus, fixed, noise, d, n_x, n_y, covariance
        )
    state[D] = d
    state[N_X] = n_x
    state[N_Y] = n_y
    state[GAIN] = min(max(gain, 0.02), 50.0)


@kernel
def _moments(
    frame: FloatArray,
    cells: FloatArray,
    ratios: FloatArray,
    plan: FloatArray,
    scale: float,
    noise: float,
    state: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Moments from the last estimate, again while the footprint moves on the scale of a cell."""
    geometry = (plan[0], plan[1], plan[2], plan[3], plan[4])
    a = plan[0]
    fixed = 0.0 if plan[FREE_GAIN] > 0.0 else plan[FIXED_GAIN]
    near = 0.25 * min(plan[3], plan[4])
    for _ in range(8):
        d, n_x, n_y, gain = refine(
            frame,
            cells,
            geometry,
            ratios,
            plan[MODULUS] / scale,
            fixed,
            noise,
            state[D],
            state[N_X],
            state[N_Y],
            covariance,
        )
        grown = math.sqrt(d * (2.0 * a - d)) - math.sqrt(state[D] * (2.0 * a - state[D]))
        moved = a * math.hypot(n_x - state[N_X], n_y - state[N_Y])
        state[D], state[N_X], state[N_Y], state[GAIN] = d, n_x, n_y, gain
        if not gain > 0.0:
            return False
        if abs(grown) + moved < near:
            return True
    return False


@kernel
def _likelihood(
    frame: FloatArray,
    scale: float,
    cells: FloatArray,
    runs: IntArray,
    law: FloatArray,
    ratios: FloatArray,
    plan: FloatArray,
    variance: float,
    row: int,
    col: int,
    state: FloatArray,
    covariance: FloatArray,
    floats: FloatArray,
    owners: IntArray,
    clipped: bool,
) -> bool:
    """Maximum likelihood from the last estimate, or from the frame's moments if that fails."""
    geometry = (plan[0], plan[1], plan[2], plan[3], plan[4])
    rows, cols = frame.shape
    free = plan[FREE_GAIN] > 0.0
    small = SUMS + 22 + 2 * cols
    line_end = small + LINE_ROWS * LINES
    lines = floats[small:line_end].reshape(LINE_ROWS, LINES)
    packed = floats[line_end : line_end + PLANES * rows * cols].reshape(PLANES, rows * cols)
    noise = math.sqrt(variance) / scale
    energy, number = _energy(frame, cells, runs)
    energy *= scale * scale
    for attempt in range(2):
        if attempt == 0 and not state[WARM] > 0.0:
            continue
        state[SECOND] = 0.0
        if attempt == 1:
            _start(frame, cells, runs, ratios, plan, scale, noise, row, col, state, covariance)
        if not free:
            state[GAIN] = plan[FIXED_GAIN]
        if fit(
            frame,
            scale,
            geometry,
            cells,
            law,
            free,
            plan[SATURATION] * scale,
            plan[FLOOR] * scale if plan[FLOOR] > 0.0 else -math.inf,
            clipped,
            energy,
            number,
            variance,
            plan[TOLERANCE] if attempt == 0 else min(plan[TOLERANCE], 1.0),
            int(plan[ITERATIONS_MAX]),
            floats,
            owners,
            packed,
            lines,
            state[:RESULT],
            covariance,
        ):
            # Share of the frame's squared pressure, noise apart, that the model accounts for.
            scatter = variance * math.sqrt(2.0 * number)
            misfit = max(energy + state[RESIDUAL] - number * variance, 0.0)
            signal = max(energy - number * variance, scatter)
            state[EXPLAINED] = 1.0 - min(max(misfit - 4.0 * scatter, 0.0) / signal, 1.0)
            if state[EXPLAINED] < plan[EXPLAINED_MIN]:
                continue
            # Only pressure beyond the footprint that is no noise and no small part asks for a look.
            if misfit > 8.0 * scatter + 0.003 * energy:
                level = max(5.0 * noise, 0.15 * state[PEAK] / scale)
                state[SECOND] = presses_outside(
                    frame, cells, geometry, runs, level, state[D], state[N_X], state[N_Y]
                )
            if not state[SECOND] > 0.0:
                return True
    return False


@kernel
def _tell(plan: FloatArray, state: FloatArray, covariance: FloatArray) -> None:
    """Turn the estimate from normals in the sensor's axes to tilts in the finger's."""
    c = math.cos(plan[ROTATION])
    s = math.sin(plan[ROTATION])
    n_x = c * state[N_X] - s * state[N_Y]
    n_y = s * state[N_X] + c * state[N_Y]
    state[TILT_X] = math.asin(n_x)
    state[TILT_Y] = math.asin(n_y)
    # ∂tilt/∂n = 1/cos tilt.
    turn = np.zeros((4, 4))
    turn[0, 0] = 1.0
    turn[1, 1] = c / math.sqrt(1.0 - n_x * n_x)
    turn[1, 2] = -s / math.sqrt(1.0 - n_x * n_x)
    turn[2, 1] = s / math.sqrt(1.0 - n_y * n_y)
    turn[2, 2] = c / math.sqrt(1.0 - n_y * n_y)
    turn[3, 3] = 1.0
    for i in range(4):
        for j in range(4):
            value = 0.0
            for k in range(4):
                for m in range(4):
                    value += turn[i, k] * covariance[4 * k + m] * turn[j, m]
            state[COVARIANCE + 4 * i + j] = value


@kernel
def estimate_frame(
    frame: FloatArray,
    scale: float,
    step: float,
    plan: FloatArray,
    cells: FloatArray,
    tables: FloatArray,
    state: FloatArray,
    floats: FloatArray,
    integers: IntArray,
) -> None:
    """One frame → the estimate in ``state``. The only compiled entry of the estimator.

    ``frame`` float64 [rows, cols] in counts, ``scale`` Pa a count, ``step`` the width of a count's
    quantum [Pa], 0 for none. ``tables`` are the moments' ratios and the law, ``integers`` the runs
    of the tip's disc and scratch, ``floats`` scratch.
    """
    rows = frame.shape[0]
    ratios = tables[: 3 * RATIO_POINTS].reshape(RATIO_POINTS, 3)
    law = tables[3 * RATIO_POINTS :].reshape((tables.size - 3 * RATIO_POINTS) // 4, 4)
    runs = integers[: 2 * rows].reshape(rows, 2)
    owners = integers[2 * rows :].reshape(2, OWNERS)
    variance = plan[NOISE] ** 2 + step * step / 12.0
    noise = math.sqrt(variance) / scale
    state[CONTACT:STATE] = 0.0
    state[CHI2] = 0.0
    state[CELLS] = 0.0
    state[ITERATIONS] = 0.0
    # A contact no wider than a cell strains it by about pitch²/2a² at most; gains up to 3.
    confined = 6.0 * plan[MODULUS] * (max(plan[3], plan[4]) / plan[0]) ** 2 / scale
    spikes = np.empty((SPIKES_MAX, 2), dtype=np.int64)
    rejected = 0
    contact, row, col, peak, mean, finite = activity(
        frame, cells, runs, noise, plan[PEAK_LEVEL], plan[PATCH_LEVEL]
    )
    while (
        row >= 0
        and finite
        and rejected < SPIKES_MAX
        and is_spike(frame, cells, row, col, noise, confined)
    ):
        cells[row, LIVE, col] = 0.0
        spikes[rejected, 0] = row
        spikes[rejected, 1] = col
        rejected += 1
        contact, row, col, peak, mean, finite = activity(
            frame, cells, runs, noise, plan[PEAK_LEVEL], plan[PATCH_LEVEL]
        )
    state[PEAK] = peak * scale
    state[REJECTED] = rejected
    # A baseline far below zero is a sensor to tare, not a tip in the air.
    valid = finite and mean > -3.0 * noise and rejected < SPIKES_MAX
    done = False
    if contact and finite:
        state[CONTACT] = 1.0
        covariance = np.zeros(16)
        if plan[MOMENTS_ONLY] > 0.0:
            if state[WARM] > 0.0:
                done = _moments(frame, cells, ratios, plan, scale, noise, state, covariance)
            if not done:
                _start(frame, cells, runs, ratios, plan, scale, noise, row, col, state, covariance)
                done = True
        else:
            done = _likelihood(
                frame,
                scale,
                cells,
                runs,
                law,
                ratios,
                plan,
                variance,
                row,
                col,
                state,
                covariance,
                floats,
                owners,
                step > 0.0,
            )
        if not (GAIN_MIN < state[GAIN] < GAIN_MAX and state[D] < D_MAX * plan[0]):
            done = False
        _tell(plan, state, covariance)
        valid = valid and done
    else:
        state[D] = 0.0
        state[N_X] = 0.0
        state[N_Y] = 0.0
        state[GAIN] = plan[FIXED_GAIN]
    state[VALID] = 1.0 if valid else 0.0
    state[WARM] = 1.0 if done else 0.0
    for k in range(rejected):
        cells[spikes[k, 0], LIVE, spikes[k, 1]] = 1.0


# The fit leaves its result at the start of the state.
assert (D, N_X, N_Y, GAIN, RESIDUAL) == (
    gauss_newton.D,
    gauss_newton.N_X,
    gauss_newton.N_Y,
    gauss_newton.GAIN,
    gauss_newton.RESIDUAL,
)
