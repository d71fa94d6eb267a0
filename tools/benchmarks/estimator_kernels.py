"""Compiled loops that call the estimator's entry, or one step of it, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.estimation import frame_pipeline
from softfinger.kinematics.estimation.cell_centres import (
    BOUNDS,
    FIRST,
    HEIGHT,
    LAST,
    PLANES,
    sums_inside,
)
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.estimation.moments import footprint_moments
from softfinger.kinematics.sensing.footprint import plane

FloatArray = NDArray[np.float64]
OUTPUTS = 4  # d, tilt_x, tilt_y, 1 for a valid contact


@kernel
def _loop(
    repeat: int,
    frames: FloatArray,
    cold: bool,
    plan: FloatArray,
    cells: FloatArray,
    tables: FloatArray,
    state: FloatArray,
    floats: FloatArray,
    integers: NDArray[np.int64],
    out: FloatArray,
) -> None:
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            if cold:
                state[frame_pipeline.WARM] = 0.0
            frame_pipeline.estimate_frame(
                frames[k], 1.0, 0.0, plan, cells, tables, state, floats, integers
            )
            out[k, 0] = state[frame_pipeline.D]
            out[k, 1] = state[frame_pipeline.TILT_X]
            out[k, 2] = state[frame_pipeline.TILT_Y]
            out[k, 3] = state[frame_pipeline.VALID] * state[frame_pipeline.CONTACT]


def run_frames(
    estimator: ContactEstimator, frames: FloatArray, out: FloatArray, cold: bool, repeat: int = 1
) -> None:
    """Estimate each frame [n, rows, cols] Pa ``repeat`` times; the results into ``out`` [n, 4]."""
    _loop(repeat, frames, cold, *estimator.compiled_arguments(), out)


def whole_grid(estimator: ContactEstimator) -> ContactEstimator:
    """The same estimator made to look at all cells, not only at those of the tip's disc."""
    floats, integers = estimator.compiled_arguments()[4:]
    size = estimator.grid.rows * estimator.grid.cols
    height = floats[HEIGHT * size : (HEIGHT + 1) * size]
    height[:] = np.maximum(height, 0.0)
    integers[:BOUNDS] = 0, size, size
    return estimator


@kernel
def _moments_loop(
    repeat: int,
    frames: FloatArray,
    boxed: bool,
    plan: FloatArray,
    middles: FloatArray,
    bounds: NDArray[np.int64],
    truth: tuple[float, float, float],
    out: FloatArray,
) -> None:
    geometry = (plan[0], plan[1], plan[2], plan[3], plan[4])
    a, d = plan[0], truth[0]
    u, v, w = plane(a, d, truth[1], truth[2])
    rows, cols = frames.shape[1], frames.shape[2]
    own = (plan[3] * plan[3] + plan[4] * plan[4]) / 12.0
    for _ in range(repeat):
        for k in range(frames.shape[0]):
            if boxed:
                found = footprint_moments(frames[k], middles, bounds, geometry, u, v, w, own)
            else:
                found = disc_moments(frames[k], middles, bounds, rows * cols, u, v, w)
            out[k, 0] = found[0]


@kernel
def disc_moments(
    frame: FloatArray,
    middles: FloatArray,
    bounds: NDArray[np.int64],
    size: int,
    u: float,
    v: float,
    w: float,
) -> tuple[float, float, float, float, float]:
    """The same sums as the footprint's, over all rows of the tip's disc."""
    return sums_inside(address(frame), address(middles), size, bounds[FIRST], bounds[LAST], u, v, w)


def run_moments(
    estimator: ContactEstimator,
    frames: FloatArray,
    truth: tuple[float, float, float],
    boxed: bool,
    out: FloatArray,
    repeat: int = 1,
) -> None:
    """The moments' sums for a contact (d, n_x, n_y), over the rows of its box or all; Σp in out."""
    plan, _, _, _, floats, integers = estimator.compiled_arguments()
    size = frames[0].size
    middles = floats[: PLANES * size].reshape(PLANES, size)
    _moments_loop(repeat, frames, boxed, plan, middles, integers, truth, out)
