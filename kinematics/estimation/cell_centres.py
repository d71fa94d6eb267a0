"""Geometry of cell centres, and kernels for sums over cells.

Vectorised loops use unsigned indices, because Numba checks signed indices for negative values.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, index, inner_kernel
from softfinger.kinematics.estimation.state import Cells, Moments
from softfinger.kinematics.sensing.footprint import FloatArray, Grid


def cell_centres(
    grid: Grid, active: NDArray[np.bool_], radius: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return height, x and y of the cells as flat arrays; ``active`` [rows, cols] masks cells.

    The height is √(a² − x² − y²) at the cell centre, or at the corner nearest to the tip centre if
    the cell centre is outside the rim. The height is −∞ for inactive cells and for cells outside
    the disc of ``radius`` [m] around the tip centre.
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
    return np.where(touched & active, height, -math.inf).ravel(), x.ravel(), y.ravel()


@fast_inner_kernel
def totals(frame: FloatArray, height: FloatArray) -> tuple[float, float, float]:
    """Return Σ p, Σ p² and the maximum of 0 and all p; non-finite cells make Σ p non-finite."""
    total = 0.0
    energy = 0.0
    peak = np.int64(0)
    for k in range(index(0), index(frame.shape[0])):
        value = frame[k] if height[k] >= 0.0 else 0.0
        total += value
        energy += value * value
        # Non-negative floats have the same order as their bit patterns. Comparing the bit patterns
        # avoids special cases for NaN.
        bits = np.float64(value).view(np.int64)
        peak = bits if bits > peak else peak
    return total, energy, np.int64(peak).view(np.float64)


@fast_inner_kernel
def sums_above(m: Moments, frame: FloatArray, cells: Cells, level: float) -> None:
    """Store the sums of p, p x and p y and the number of cells with p above ``level`` in ``m``."""
    total = sum_x = sum_y = number = 0.0
    for k in range(index(0), index(frame.shape[0])):
        counts = (cells.height[k] >= 0.0) & (frame[k] > level)
        value = frame[k] if counts else 0.0
        total += value
        sum_x += value * cells.x[k]
        sum_y += value * cells.y[k]
        number += 1.0 if counts else 0.0
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.number = number


@fast_inner_kernel
def sums_inside(m: Moments, frame: FloatArray, cells: Cells, u: float, v: float, w: float) -> None:
    """Sum p, p x, p y and p (x² + y²) over the cells whose centre is pressed by the face."""
    total = sum_x = sum_y = square = 0.0
    for k in range(index(0), index(frame.shape[0])):
        x = cells.x[k]
        y = cells.y[k]
        value = frame[k] if cells.height[k] > u - v * x - w * y else 0.0
        total += value
        sum_x += value * x
        sum_y += value * y
        square += value * (x * x + y * y)
    m.total = total
    m.x = sum_x
    m.y = sum_y
    m.trace = square


@inner_kernel
def next_above(frame: FloatArray, height: FloatArray, start: int, last: int, level: float) -> int:
    """Return the first cell in start..last with a reading ≥ ``level``, or ``last`` if none."""
    while start < last and not (frame[start] >= level and height[start] >= 0.0):
        start += 1
    return start
