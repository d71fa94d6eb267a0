"""Cells that read high alone, as no contact can make them: found and left out, as kernels."""

from __future__ import annotations

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer
from softfinger.kinematics.estimation.detection import activity
from softfinger.kinematics.estimation.state import OUTLIERS_MAX, EstimatorState
from softfinger.kinematics.sensing.cell_integrals import CELL_PLANES, LIVE

_DEAD = 1e3  # m below: no face is ever there


@inner_kernel
def _is_outlier(state: EstimatorState, frame: Pointer, height: Pointer) -> bool:
    """Whether the largest cell stands alone as no contact can.

    A contact about as wide as a cell could press ``signal.confined`` at most: a wider one never has
    a cell that stands at twice its neighbours.
    """
    rows = state.grid.rows
    cols = state.grid.cols
    i = state.signal.row
    j = state.signal.col
    total = 0.0
    number = 0
    for k, m in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
        if 0 <= k < rows and 0 <= m < cols and height[k * cols + m] >= 0.0:
            total += frame[k * cols + m]
            number += 1
    reading = frame[i * cols + j]
    noise = state.signal.noise
    return bool(
        number > 0
        and reading > 10.0 * noise + state.signal.confined
        and reading > 2.0 * max(total, 0.0) / max(number, 1) + 12.0 * noise
    )


@inner_kernel
def without_outliers(state: EstimatorState, frame: Pointer, cells: Pointer, height: Pointer) -> int:
    """The number of outliers; ``state.signal`` is what :func:`activity` finds without them.

    They are marked dead until :func:`restore_outliers`.
    """
    signal = state.signal
    cols = state.grid.cols
    rejected = 0
    activity(state, frame, height)
    while (
        signal.peak > 10.0 * signal.noise + signal.confined
        and signal.row >= 0
        and rejected < OUTLIERS_MAX
        and _is_outlier(state, frame, height)
    ):
        cells[(signal.row * CELL_PLANES + LIVE) * cols + signal.col] = 0.0
        at = signal.row * cols + signal.col
        height[at] -= _DEAD
        state.reach.number -= 1
        state.outliers[rejected] = at
        rejected += 1
        activity(state, frame, height)
    return rejected


@inner_kernel
def restore_outliers(state: EstimatorState, rejected: int, cells: Pointer, height: Pointer) -> None:
    """Make the outliers live again."""
    cols = state.grid.cols
    for k in range(rejected):
        at = state.outliers[k]
        row = at // cols
        cells[(row * CELL_PLANES + LIVE) * cols + at - row * cols] = 1.0
        height[at] += _DEAD
        state.reach.number += 1
