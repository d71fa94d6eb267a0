"""The estimator's one compiled entry: one pressure frame up the ladder.

Holds the order of the steps for a frame and the layout of the arrays that go in and out: activity
test, hot cells, then moments or maximum likelihood, from the last estimate or from the frame alone.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.unowned import borrowed
from softfinger.kinematics.estimation import gauss_newton
from softfinger.kinematics.estimation.cell_centres import NUMBER
from softfinger.kinematics.estimation.detection import presses_outside
from softfinger.kinematics.estimation.gauss_newton import RESULT, fit
from softfinger.kinematics.estimation.moments import RATIO_POINTS, coarse, coarse_weak, refine
from softfinger.kinematics.estimation.outliers import revive, without_spikes
from softfinger.kinematics.estimation.scratch import MIDDLES, SPIKES_MAX
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray

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
    BLUR,
) = range(5, 19)
OPTIONS = 19

# Noise that ends at 0 raises its neighbourhoods' sums: so much more makes alarms as rare again.
CLIPPED_MORE = 0.5
WEAK = 15.0  # noise: a largest cell below is looked for together with its neighbours
GAIN_MIN, GAIN_MAX = 0.05, 20.0  # outside it's not this tip on this sensor
D_MAX = 0.75  # of the radius


@inner_kernel
def _start(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
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
        d, n_x, n_y = coarse(frame, middles, bounds, geometry, level, row, col)
    else:
        level = 2.0 * noise
        patch = plan[PATCH_LEVEL] * noise
        d, n_x, n_y = coarse_weak(frame, middles, bounds, geometry, level, patch, row, col)
    fixed = 0.0 if plan[FREE_GAIN] > 0.0 else plan[FIXED_GAIN]
    modulus = plan[MODULUS] / scale
    gain = 1.0
    for _ in range(2):
        d, n_x, n_y, gain = refine(
            frame,
            middles,
            bounds,
            geometry,
            ratios,
            modulus,
            fixed,
            noise,
            plan[BLUR],
            d,
            n_x,
            n_y,
            covariance,
        )
    state[D] = d
    state[N_X] = n_x
    state[N_Y] = n_y
    state[GAIN] = min(max(gain, 0.02), 50.0)


@inner_kernel
def _moments(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
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
    near = 0.5 * min(plan[3], plan[4])
    for _ in range(8):
        d, n_x, n_y, gain = refine(
            frame,
            middles,
            bounds,
            geometry,
            ratios,
            plan[MODULUS] / scale,
            fixed,
            noise,
            plan[BLUR],
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


@inner_kernel
def _likelihood(
    frame: FloatArray,
    scale: float,
    cells: FloatArray,
    middles: FloatArray,
    law: FloatArray,
    ratios: FloatArray,
    plan: FloatArray,
    variance: float,
    energy: float,
    row: int,
    col: int,
    state: FloatArray,
    covariance: FloatArray,
    floats: FloatArray,
    integers: IntArray,
    clipped: bool,
) -> bool:
    """Maximum likelihood from the last estimate, or from the frame's moments if that fails."""
    geometry = (plan[0], plan[1], plan[2], plan[3], plan[4])
    free = plan[FREE_GAIN] > 0.0
    noise = math.sqrt(variance) / scale
    number = float(integers[NUMBER])
    for attempt in range(2):
        if attempt == 0 and not state[WARM] > 0.0:
            continue
        state[SECOND] = 0.0
        if attempt == 1:
            _start(
                frame, middles, integers, ratios, plan, scale, noise, row, col, state, covariance
            )
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
            plan[FLOOR] * scale if clipped or plan[FLOOR] > 0.0 else -math.inf,
            clipped,
            energy,
            number,
            variance,
            plan[TOLERANCE] if attempt == 0 else min(plan[TOLERANCE], 1.0),
            int(plan[ITERATIONS_MAX]),
            floats,
            integers,
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
                    frame,
                    middles,
                    geometry,
                    integers,
                    level,
                    state[D],
                    state[N_X],
                    state[N_Y],
                    plan[BLUR],
                )
            if not state[SECOND] > 0.0:
                return True
    return False


@inner_kernel
def _tell(plan: FloatArray, state: FloatArray, covariance: FloatArray) -> None:
    """Turn the estimate from normals in the sensor's axes to tilts in the finger's."""
    c = math.cos(plan[ROTATION])
    s = math.sin(plan[ROTATION])
    n_x = c * state[N_X] - s * state[N_Y]
    n_y = s * state[N_X] + c * state[N_Y]
    state[TILT_X] = math.asin(n_x)
    state[TILT_Y] = math.asin(n_y)
    # ∂tilt/∂n = 1/cos tilt. Only the two middle rows and columns turn.
    per_x = 1.0 / math.sqrt(1.0 - n_x * n_x)
    per_y = 1.0 / math.sqrt(1.0 - n_y * n_y)
    for j in range(4):
        along = covariance[4 + j]
        across = covariance[8 + j]
        covariance[4 + j] = per_x * (c * along - s * across)
        covariance[8 + j] = per_y * (s * along + c * across)
    for i in range(0, 16, 4):
        along = covariance[i + 1]
        across = covariance[i + 2]
        state[COVARIANCE + i] = covariance[i]
        state[COVARIANCE + i + 1] = per_x * (c * along - s * across)
        state[COVARIANCE + i + 2] = per_y * (s * along + c * across)
        state[COVARIANCE + i + 3] = covariance[i + 3]


@inner_kernel
def _climb(
    frame: FloatArray,
    scale: float,
    clipped: bool,
    variance: float,
    energy: float,
    row: int,
    col: int,
    plan: FloatArray,
    cells: FloatArray,
    middles: FloatArray,
    tables: FloatArray,
    state: FloatArray,
    floats: FloatArray,
    integers: IntArray,
) -> bool:
    """The estimate of a frame with a contact into ``state``; whether it can be used."""
    ratios = tables[: 3 * RATIO_POINTS].reshape(RATIO_POINTS, 3)
    covariance = floats[:16]  # see workspace.py
    noise = math.sqrt(variance) / scale
    done = False
    if plan[MOMENTS_ONLY] > 0.0:
        if state[WARM] > 0.0:
            done = _moments(frame, middles, integers, ratios, plan, scale, noise, state, covariance)
        if not done:
            _start(
                frame, middles, integers, ratios, plan, scale, noise, row, col, state, covariance
            )
            done = True
    else:
        done = _likelihood(
            frame,
            scale,
            cells,
            middles,
            tables[3 * RATIO_POINTS :].reshape((tables.size - 3 * RATIO_POINTS) // 4, 4),
            ratios,
            plan,
            variance,
            energy,
            row,
            col,
            state,
            covariance,
            floats,
            integers,
            clipped,
        )
    if not (GAIN_MIN < state[GAIN] < GAIN_MAX and state[D] < D_MAX * plan[0]):
        done = False
    _tell(plan, state, covariance)
    return done


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

    ``frame`` float64 [rows, cols] in counts, contiguous, ``scale`` Pa a count, ``step`` the width
    of a count's quantum [Pa], 0 for none. ``cells`` are the grid's planes, ``tables`` the moments'
    ratios and the law, ``floats`` and ``integers`` what workspace.py says.
    """
    frame = borrowed(frame)
    plan = borrowed(plan)
    cells = borrowed(cells)
    tables = borrowed(tables)
    state = borrowed(state)
    floats = borrowed(floats)
    integers = borrowed(integers)
    size = frame.size
    middles = floats[: MIDDLES * size].reshape(MIDDLES, size)
    scratch = floats[MIDDLES * size :]
    variance = plan[NOISE] ** 2 + step * step / 12.0
    noise = math.sqrt(variance) / scale
    state[CONTACT:STATE] = 0.0
    state[CHI2] = 0.0
    state[CELLS] = 0.0
    state[ITERATIONS] = 0.0
    # A contact no wider than a cell strains it by about pitch²/2a² at most; gains up to 3.
    confined = 6.0 * plan[MODULUS] * (max(plan[3], plan[4]) / plan[0]) ** 2 / scale
    patch_level = plan[PATCH_LEVEL] + (CLIPPED_MORE if step > 0.0 else 0.0)
    rejected, seen = without_spikes(
        frame, noise, plan[PEAK_LEVEL], patch_level, confined, cells, middles, integers
    )
    contact, row, col, peak, mean, energy, finite = seen
    state[PEAK] = peak * scale
    state[REJECTED] = rejected
    done = False
    if contact:
        state[CONTACT] = 1.0
        done = _climb(
            frame,
            scale,
            step > 0.0,
            variance,
            energy * scale * scale,
            row,
            col,
            plan,
            cells,
            middles,
            tables,
            state,
            scratch,
            integers,
        )
    else:
        state[D] = 0.0
        state[N_X] = 0.0
        state[N_Y] = 0.0
        state[GAIN] = plan[FIXED_GAIN]
    # A baseline far below zero is a sensor to tare, not a tip in the air.
    sound = finite and mean > -3.0 * noise and rejected < SPIKES_MAX and (done or not contact)
    state[VALID] = 1.0 if sound else 0.0
    state[WARM] = 1.0 if done else 0.0
    if rejected > 0:
        revive(rejected, cells, middles, integers)


# The fit leaves its result at the start of the state.
assert (D, N_X, N_Y, GAIN, RESIDUAL) == (
    gauss_newton.D,
    gauss_newton.N_X,
    gauss_newton.N_Y,
    gauss_newton.GAIN,
    gauss_newton.RESIDUAL,
)
