"""A grid's cells by their centres: those that may be touched, and sums over them, as kernels.

The planes here lie flat, cell after cell, so that a sum over many cells is one loop in SIMD lanes
without a start and an end for each row; which cells count is decided cell by cell, by a comparison
that the lanes make for free. Kernels take addresses, see :data:`compiled.simd.address`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import fast_inner_kernel
from softfinger.kinematics.compiled.simd import Pointer
from softfinger.kinematics.estimation.state import Moments, Region
from softfinger.kinematics.sensing.footprint import FloatArray, Grid

# Planes, float64 [PLANES, rows · cols]: the tip's height √(a² − x² − y²) over the cell's centre, or
# over its nearest corner where the centre lies beyond the rim, and −∞ for a cell that is dead or
# outside the region; the centre's x and y.
HEIGHT, X, Y = range(3)
PLANES = 3


def cell_centres(
    grid: Grid, active: NDArray[np.bool_], radius: float, region: Region
) -> FloatArray:
    """Return the planes of a grid with the mask ``active`` [rows, cols]; fill in ``region``.

    A cell is in the region when the disc of radius ``radius`` [m] round the tip's centre touches
    it.
    """
    a, pitch_x, pitch_y = grid.radius, grid.pitch_x, grid.pitch_y
    rows, cols = active.shape
    x, y = np.meshgrid(
        grid.x + pitch_x * (np.arange(cols) + 0.5), grid.y + pitch_y * (np.arange(rows) + 0.5)
    )
    nearest_x = np.maximum(np.abs(x) - 0.5 * pitch_x, 0.0)
    nearest_y = np.maximum(np.abs(y) - 0.5 * pitch_y, 0.0)
    touched = nearest_x**2 + nearest_y**2 < radius * radius
    near = np.maximum(a * a - nearest_x**2 - nearest_y**2, 0.0)
    inside = a * a - x * x - y * y
    height = np.sqrt(np.where(inside > 0.0, inside, near))
    reached = np.flatnonzero(touched.any(axis=1))
    if len(reached):
        region.first, region.last = int(reached[0]) * cols, (int(reached[-1]) + 1) * cols
    region.number = int(np.count_nonzero(touched & active))
    return np.stack([np.where(touched & active, height, -math.inf), x, y]).reshape(PLANES, -1)


@fast_inner_kernel
def totals(frame: Pointer, height: Pointer, first: int, last: int) -> tuple[float, float, float]:
    """Return Σ p (not finite where a cell is not), Σ p² and the largest p ≥ 0, of first..last."""
    total = 0.0
    energy = 0.0
    peak = np.int64(0)
    for k in range(first, last):
        value = frame[k]
        value = value if height[k] >= 0.0 else 0.0
        total += value
        energy += value * value
        # Numbers that are not negative rank as their bits do, and those have no NaN.
        bits = np.float64(value).view(np.int64)
        peak = bits if bits > peak else peak
    return total, energy, np.int64(peak).view(np.float64)


@fast_inner_kernel
def sums_above(
    m: Moments, region: Region, frame: Pointer, centres: Pointer, size: int, level: float
) -> None:
    """Sum p, p x, p y and the number of the cells in the region with p above ``level``, into ``m``.

    ``size`` is that of a plane.
    """
    total = sum_x = sum_y = number = 0.0
    for k in range(region.first, region.last):
        value = frame[k]
        counts = (centres[k] >= 0.0) & (value > level)
        value = value if counts else 0.0
        total += value
        sum_x += value * centres[size + k]
        sum_y += value * centres[2 * size + k]
        number += 1.0 if counts else 0.0
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.number = number


@fast_inner_kernel
def sums_inside(
    m: Moments, frame: Pointer, centres: Pointer, size: int, first: int, last: int
) -> None:
    """Sum p, p x, p y, p (x² + y²) of cells first..last whose centre ``m.face`` has pressed."""
    u = m.face.u
    v = m.face.v
    w = m.face.w
    total = sum_x = sum_y = square = number = 0.0
    for k in range(first, last):
        x = centres[size + k]
        y = centres[2 * size + k]
        inside = centres[k] > u - v * x - w * y
        value = frame[k]
        value = value if inside else 0.0
        along_x = value * x
        along_y = value * y
        total += value
        sum_x += along_x
        sum_y += along_y
        square += along_x * x + along_y * y
        number += 1.0 if inside else 0.0
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.trace = square
    m.number = number


@fast_inner_kernel
def _any_reads(frame: Pointer, start: int, level: float) -> bool:
    """Return whether one of 64 cells reads ``level``, in the region or not: half of the memory."""
    found = False
    for k in range(start, start + 64):
        found |= frame[k] >= level
    return found


@fast_inner_kernel
def _any_of_64(frame: Pointer, height: Pointer, start: int, level: float) -> bool:
    found = False
    for k in range(start, start + 64):
        found |= (frame[k] >= level) & (height[k] >= 0.0)
    return found


@fast_inner_kernel
def _any_of_8(frame: Pointer, height: Pointer, start: int, level: float) -> bool:
    found = False
    for k in range(start, start + 8):
        found |= (frame[k] >= level) & (height[k] >= 0.0)
    return found


@fast_inner_kernel
def next_above(frame: Pointer, height: Pointer, start: int, last: int, level: float) -> int:
    """Return the first cell in start..last that reads ``level`` or more; ``last`` if none does."""
    while start + 64 <= last and not (
        _any_reads(frame, start, level) and _any_of_64(frame, height, start, level)
    ):
        start += 64
    while start + 8 <= last and not _any_of_8(frame, height, start, level):
        start += 8
    while start < last and not (frame[start] >= level and height[start] >= 0.0):
        start += 1
    return start
