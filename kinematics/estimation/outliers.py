"""Cells that read high alone, as no contact can make them: found and left out, as kernels."""

from __future__ import annotations

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address
from softfinger.kinematics.estimation.cell_centres import HEIGHT, NUMBER
from softfinger.kinematics.estimation.detection import activity
from softfinger.kinematics.estimation.scratch import SPIKES, SPIKES_MAX
from softfinger.kinematics.sensing.cell_integrals import LIVE
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray

_DEAD = 1e3  # m below: no face is ever there


@inner_kernel
def is_spike(
    frame: Pointer,
    height: Pointer,
    rows: int,
    cols: int,
    i: int,
    j: int,
    noise: float,
    confined: float,
) -> bool:
    """Whether the cell stands alone as no contact can: a hot cell.

    ``confined`` is what a contact about as wide as a cell could press at most: a wider one never
    has a cell that stands at twice its neighbours.
    """
    total = 0.0
    number = 0
    for k, m in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
        if 0 <= k < rows and 0 <= m < cols and height[k * cols + m] >= 0.0:
            total += frame[k * cols + m]
            number += 1
    reading = frame[i * cols + j]
    return bool(
        number > 0
        and reading > 10.0 * noise + confined
        and reading > 2.0 * max(total, 0.0) / max(number, 1) + 12.0 * noise
    )


@inner_kernel
def without_spikes(
    frame: FloatArray,
    noise: float,
    peak_level: float,
    patch_level: float,
    confined: float,
    cells: FloatArray,
    middles: FloatArray,
    integers: IntArray,
) -> tuple[int, tuple[bool, int, int, float, float, float, bool]]:
    """The number of hot cells, and what :func:`activity` says without them.

    ``confined`` as for :func:`is_spike`. They are marked dead until :func:`revive`; their places
    are left in ``integers``.
    """
    rows, cols = frame.shape
    rejected = 0
    seen = activity(frame, middles, integers, noise, peak_level, patch_level)
    while (
        seen[3] > 10.0 * noise + confined
        and seen[1] >= 0
        and rejected < SPIKES_MAX
        and is_spike(
            address(frame), address(middles), rows, cols, seen[1], seen[2], noise, confined
        )
    ):
        cells[seen[1], LIVE, seen[2]] = 0.0
        middles[HEIGHT, seen[1] * cols + seen[2]] -= _DEAD
        integers[NUMBER] -= 1
        integers[SPIKES + rejected] = seen[1] * cols + seen[2]
        rejected += 1
        seen = activity(frame, middles, integers, noise, peak_level, patch_level)
    return rejected, seen


@inner_kernel
def revive(rejected: int, cells: FloatArray, middles: FloatArray, integers: IntArray) -> None:
    """Make the hot cells of :func:`without_spikes` live again."""
    cols = cells.shape[2]
    for k in range(rejected):
        at = integers[SPIKES + k]
        cells[at // cols, LIVE, at % cols] = 1.0
        middles[HEIGHT, at] += _DEAD
        integers[NUMBER] += 1
