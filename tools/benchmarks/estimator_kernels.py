"""A compiled loop that calls the estimator's entry frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics import ladder
from kinematics.estimator import ContactEstimator
from kinematics.kernels import kernel
from kinematics.middles import BOUNDS, HEIGHT

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
                state[ladder.WARM] = 0.0
            ladder.estimate_frame(frames[k], 1.0, 0.0, plan, cells, tables, state, floats, integers)
            out[k, 0] = state[ladder.D]
            out[k, 1] = state[ladder.TILT_X]
            out[k, 2] = state[ladder.TILT_Y]
            out[k, 3] = state[ladder.VALID] * state[ladder.CONTACT]


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
