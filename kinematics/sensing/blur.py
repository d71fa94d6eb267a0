"""The elastomer over a sensor spreads a point's pressure: a Gaussian blur, forward and in the fit.

A cell reads c(x) = (p ∗ box)(x), and a blurred one ∫ G(t) c(x − t) dt with the Gaussian G of the
standard deviation w in both directions. c is smooth on the scale of a cell, so that the integral is
a weighted sum of neighbouring cells' c, first along one axis and then along the other. The forward
model takes that sum on a finer grid, the fit on one of half cells, or of cells if that will do.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.sensing.footprint import FloatArray

_MATCHED = 0.75  # steps: below it weights that match moments, above it samples of the Gaussian
_CUTOFF = 4.5  # standard deviations
_PIECES_MAX = 8


def stencil(width: float) -> FloatArray:
    """Return the blur's weights over neighbouring cells, float64 [2 n + 1]; ``width`` in cells.

    Samples of the Gaussian: the trapezoid rule, whose error falls like exp(−2π² w²). Below
    three quarters of a cell five weights of the Gaussian's moments up to the fifth, which are exact
    for polynomials of that degree. One weight of 1 without a blur.
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


def pieces(width: float) -> int:
    """Return the pieces of a cell's side in the forward model; ``width`` in cells."""
    return min(max(math.ceil(1.0 / width), 2), _PIECES_MAX)


def average(
    fine: FloatArray, across: FloatArray, along: FloatArray, n: tuple[int, int]
) -> FloatArray:
    """Blur ``fine`` by the stencils along x and y and average it over cells of n = (x, y) pieces.

    ``fine`` has the stencils' half lengths more on each side than there are pieces.
    """
    cols = (fine.shape[1] - len(across) + 1) // n[0]
    rows = (fine.shape[0] - len(along) + 1) // n[1]
    # The mean over a cell's pieces goes into the weights, so that only cells are summed.
    half = np.zeros((fine.shape[0], cols))
    for k, weight in enumerate(np.convolve(across, np.full(n[0], 1.0 / n[0]))):
        half += weight * fine[:, k : k + cols * n[0] : n[0]]
    whole = np.zeros((rows, cols))
    for k, weight in enumerate(np.convolve(along, np.full(n[1], 1.0 / n[1]))):
        whole += weight * half[k : k + rows * n[1] : n[1]]
    return whole
