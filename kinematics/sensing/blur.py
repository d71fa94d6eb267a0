"""Compute sample points along one axis of a grid, and the weights that average each cell's points.

The elastomer over a sensor spreads pressure like a Gaussian blur. A Gaussian blur is a weighted sum
of neighbouring points along one axis, followed by a weighted sum along the other axis. The weights
that average the points of a cell therefore include the blur. Without blur, a cell averages its own
points with equal weights.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.compiled.layout import FloatArray

# Maximum blur width for moment-matching weights, in points. For larger widths, the weights are
# Gaussian samples.
_MOMENT_MATCHED_MAX = 0.75
_CUTOFF = 4.5  # truncation of the Gaussian, in standard deviations


def axis_points(
    start: float, pitch: float, number: int, count: int, blur: float
) -> tuple[FloatArray, FloatArray]:
    """Return the positions of points [count, cells], and the weights that average a cell's points.

    The axis has ``number`` cells of width ``pitch``, and the first cell begins at ``start``. At
    both ends, additional cells cover the range of the blur. The mean of cell j is the sum of
    weights[m, q] times point m of cell j + q, over all m and q.
    """
    mean = np.convolve(stencil(blur * count / pitch), np.full(count, 1.0 / count))
    half = (len(mean) - count) // 2
    more = -(-half // count)
    padded = np.zeros((2 * more + 1) * count)
    padded[more * count - half : more * count - half + len(mean)] = mean
    cell = np.arange(number + 2 * more) - more
    places = start + pitch * (cell + (np.arange(count)[:, None] + 0.5) / count)
    return places, np.ascontiguousarray(padded.reshape(-1, count).T)


def cell_means(points: FloatArray, along: FloatArray, across: FloatArray) -> FloatArray:
    """Average ``points`` [lines, points per line] over each cell; the result is [rows, cols].

    :func:`axis_points` defines the weights ``along`` (for y) and ``across`` (for x), and the order
    of the points. The points of a cell are consecutive.
    """
    for weights in (across, along):
        count, reach = weights.shape
        parts = (points.reshape(-1, count) @ weights).reshape(len(points), -1, reach)
        cells = parts.shape[1] - reach + 1
        points = np.sum([parts[:, q : q + cells, q] for q in range(reach)], axis=0).T
    return points


def stencil(width: float) -> FloatArray:
    """Return the weights [2 n + 1] of neighbouring points for a blur with a ``width`` of w points.

    The weights are samples of the Gaussian (trapezoid rule). The error of the samples decreases as
    exp(−2π² w²). For widths below 0.75 points, five weights match the Gaussian's moments up to
    order five. The five weights are therefore exact for polynomials up to degree five. Without
    blur, the only weight is 1.
    """
    if width == 0.0:
        return np.ones(1)
    if width < _MOMENT_MATCHED_MAX:
        square = width * width
        far = (3.0 * square * square - square) / 24.0
        near = 0.5 * square - 4.0 * far
        return np.array([far, near, 1.0 - 2.0 * (near + far), near, far])
    n = math.ceil(_CUTOFF * width)
    weights = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    return np.asarray(weights / weights.sum())
