"""Layout of the estimator's two working arrays, made once, that every frame reuses.

A kernel that made its own would pay for the memory at each call, and each array that goes through a
compiled function costs counts of its references.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softfinger.kinematics.compiled.simd_sums import LANES
from softfinger.kinematics.estimation import cell_centres
from softfinger.kinematics.estimation.cut_cells import LEVELS, OWNERS, PLANES, STRIP_ROWS, STRIPS
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray

# Floats: the planes of estimation.cell_centres, that many numbers a cell, then scratch, by its
# place: covariance of the estimate, then of one step of the fit the sums, the
# step, the inverse normal matrix and what solving takes.
COVARIANCE = 0
SUMS = COVARIANCE + 16
STEP = SUMS + 17
INVERSE = STEP + 4
WORK = INVERSE + 16
GRID = WORK + 40  # from here on sizes depend on the grid: see `make`

MIDDLES = cell_centres.PLANES

# Integers: the bounds of estimation.cell_centres; in how many parts a cell is modelled along x and
# y, how many parts a blur reaches, and how many weights that makes; the places of hot cells, then
# the queues of strips, and where there is a blur the places of the footprint's parts.
PARTS_X = cell_centres.BOUNDS
PARTS_Y = PARTS_X + 1
SPREAD_X = PARTS_Y + 1
SPREAD_Y = SPREAD_X + 1
WEIGHTS_X = SPREAD_Y + 1
WEIGHTS_Y = WEIGHTS_X + 1
SPIKES = WEIGHTS_Y + 1
SPIKES_MAX = 6  # hot cells left out of one frame
QUEUES = SPIKES + SPIKES_MAX
OWNED = QUEUES + 2 * LEVELS
INTEGERS = OWNED + LEVELS * 2 * OWNERS


@dataclass(frozen=True)
class Parts:
    """The finer grid of a blurred model: (x, y) parts of a cell and how many the blur reaches.

    ``planes`` [rows, CELL_PLANES, cols] are the parts', ``across`` and ``along`` their weights, see
    :func:`estimation.blurred_cells.weights`.
    """

    number: tuple[int, int]
    reach: tuple[int, int]
    across: FloatArray
    along: FloatArray
    planes: FloatArray


def make(
    planes: FloatArray, bounds: IntArray, shape: tuple[int, int], parts: Parts | None
) -> tuple[FloatArray, IntArray]:
    """The float and the integer array of a grid of ``shape``, and of its parts with a blur.

    ``planes`` and ``bounds`` are those of :func:`estimation.cell_centres.cell_middles`.
    """
    rows, cols = shape
    tail = np.zeros(0)
    places = scratch = 0
    number, reach = (1, 1), (0, 0)
    if parts is not None:
        number, reach = parts.number, parts.reach
        rows, _, cols = parts.planes.shape
        tail = np.concatenate([parts.across, parts.along, parts.planes.ravel()])
        places = rows * cols
        width = number[0] * (shape[1] + 2 * LANES) + len(parts.across)
        scratch = (rows + 2) * width
    used = planes.size + GRID + 2 * (rows + cols + 2) + LEVELS * STRIP_ROWS * STRIPS
    used += PLANES * rows * cols
    floats = np.zeros(used + tail.size + scratch)
    floats[: planes.size] = planes.ravel()
    floats[used : used + tail.size] = tail
    integers = np.zeros(INTEGERS + places, dtype=np.int64)
    integers[: len(bounds)] = bounds
    integers[PARTS_X : SPREAD_Y + 1] = *number, *reach
    if parts is not None:
        integers[WEIGHTS_X : WEIGHTS_Y + 1] = len(parts.across), len(parts.along)
    return floats, integers
