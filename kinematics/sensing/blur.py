"""Points of cells along one axis, and the weights by which a cell takes their mean.

The elastomer over a sensor spreads a point's pressure, a Gaussian blur. It is a weighted sum over
neighbouring points, along one axis and then along the other, so it goes into the weights by which a
cell takes the mean of points: without a blur it has its own alone, all of one weight.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_MATCHED = 0.75  # points: below it weights that match moments, above it samples of the Gaussian
_CUTOFF = 4.5  # standard deviations of the blur


def axis_points(
    start: float, pitch: float, number: int, count: int, blur: float
) -> tuple[FloatArray, FloatArray]:
    """Return the places of points [count, cells] and the weights of a cell's mean over them.

    There are ``number`` cells of ``pitch`` from ``start`` on, and as many more on both sides as the
    blur reaches: cell j is the sum over m and q of weights[m, q] times point m of cell j + q.
    """
    mean = np.convolve(stencil(blur * count / pitch), np.full(count, 1.0 / count))
    half = (len(mean) - count) // 2
    more = -(-half // count)
    padded = np.zeros((2 * more + 1) * count)
    padded[more * count - half : more * count - half + len(mean)] = mean
    cell = np.arange(number + 2 * more) - more
    places = start + pitch * (cell + (np.arange(count)[:, None] + 0.5) / count)
    return places, np.ascontiguousarray(padded.reshape(-1, count).T)


def mean_matrix(weights: FloatArray, number: int) -> FloatArray:
    """Return the weights of :func:`axis_points` as a matrix [cells, points], cell after cell."""
    count, reach = weights.shape
    matrix = np.zeros((number, (number + reach - 1) * count))
    for j in range(number):
        matrix[j, j * count : (j + reach) * count] = weights.T.ravel()
    return matrix


def stencil(width: float) -> FloatArray:
    """Return the blur's weights over neighbouring points, float64 [2 n + 1]; ``width`` in points.

    Samples of the Gaussian: the trapezoid rule, whose error falls like exp(−2π² w²). Below
    three quarters of a point five weights of the Gaussian's moments up to the fifth, which are
    exact for polynomials of that degree. One weight of 1 without a blur.
    """
    if width == 0.0:
        return np.ones(1)
    if width < _MATCHED:
        square = width * width
        far = (3.0 * square * square - square) / 24.0
        near = 0.5 * square - 4.0 * far
        return np.array([far, near, 1.0 - 2.0 * (near + far), near, far])
    n = math.ceil(_CUTOFF * width)
    weights = np.exp(-0.5 * (np.arange(-n, n + 1) / width) ** 2)
    return np.asarray(weights / weights.sum())
