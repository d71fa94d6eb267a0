"""Layout of the estimator's two working arrays, made once, that every frame reuses.

A kernel that made its own would pay for the memory at each call, and each array that goes through a
compiled function costs counts of its references.
"""

from __future__ import annotations

from kinematics import middles
from kinematics.cut_cells import LEVELS, OWNERS, PLANES, STRIP_ROWS, STRIPS

# Floats: the planes of kinematics.middles, that many numbers a cell, then scratch, by its place:
# covariance of the estimate, then of one step of the fit the sums, the
# step, the inverse normal matrix and what solving takes.
COVARIANCE = 0
SUMS = COVARIANCE + 16
STEP = SUMS + 17
INVERSE = STEP + 4
WORK = INVERSE + 16
GRID = WORK + 40  # from here on sizes depend on the grid: see `floats_needed`

MIDDLES = middles.PLANES

# Integers: the bounds of kinematics.middles, the places of hot cells, then the queues of strips.
SPIKES = middles.BOUNDS
SPIKES_MAX = 6  # hot cells left out of one frame
QUEUES = SPIKES + SPIKES_MAX
OWNED = QUEUES + 2 * LEVELS
INTEGERS = OWNED + LEVELS * 2 * OWNERS


def floats_needed(rows: int, cols: int) -> int:
    """Size of the float scratch for a grid."""
    size = rows * cols
    return (
        MIDDLES * size + GRID + 2 * (rows + cols + 2) + LEVELS * STRIP_ROWS * STRIPS + PLANES * size
    )
