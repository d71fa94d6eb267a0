"""Cells that the footprint's outline cuts, integrated for the likelihood, as kernels.

A cut cell falls into strips in y where the outline enters or leaves through a side; a strip has two
Gauss lines in y, a line two Gauss points in x, doubled towards the rim; where the outline all but
meets the rim more of them, in parts that shorten towards it, since there g grows like one over a
square root. At a noise of 0.1 % of the modulus that keeps the bias it causes below a fifth of the
noise floor up to 6° from the domain's limit, mostly far below, and below a third up to 3°, at a
third of the cost of the forward model's integrals. Lines of many cells are gathered first and
integrated in SIMD lanes.
"""

from __future__ import annotations

import math

import numpy as np

from kinematics.footprint import GAUSS_NODES, GAUSS_WEIGHTS, Crossings, FloatArray, IntArray
from kinematics.kernels import fast_kernel, kernel

# Planes of the packed footprint cells: share, means of g, x g, y g, variance of strain, reading,
# weight.
SHARE, PLAIN, ALONG_X, ALONG_Y, VARIANCE, READING, WEIGHT = range(7)
PLANES = 7

# Rows of the scratch for lines across cut cells.
Y, CELL_X, STRIP, PART_FROM, PART, AREA, LINE_G, LINE_X, LINE_Y, LINE_SQUARE = range(10)
LINE_ROWS = 10
LINES_A_CELL = 5 * 6 * 4  # five strips, six lines, four parts
LINES = 512 + LINES_A_CELL
OWNERS = 256

# How near the rim a cell is, and where a line's parts start and how long they are by that: rows are
# levels, then parts; first for cells with the rim on their right.
COARSE, FINE, FINEST = range(3)
_ENDS = ((0.0, 1.0, 1.0, 1.0, 1.0), (0.0, 0.5, 1.0, 1.0, 1.0), (0.0, 0.5, 0.75, 0.9, 1.0))
_PARTS = np.diff(_ENDS, axis=1)
PART_LENGTHS = np.stack([_PARTS, _PARTS])
PART_STARTS = np.stack([np.array(_ENDS)[:, :4], 1.0 - np.array(_ENDS)[:, 1:]])

# The two-point Gauss rule on [0, 1].
NEAR = 0.5 - 0.5 / math.sqrt(3.0)
FAR = 0.5 + 0.5 / math.sqrt(3.0)


@fast_kernel
def integrate_lines(
    lines: FloatArray, count: int, u: float, v: float, w: float, a: float, pitch_x: float
) -> None:
    """Integrals along x over the footprint's part of each line, in SIMD lanes.

    In: ``lines`` rows Y, CELL_X (the cell's left side), PART_FROM and PART of the chord that is
    integrated, and STRIP, the line's weight. Out, times that weight: rows AREA, and the integrals
    of g, x g, y g, face² g².
    """
    stretch = 1.0 + v * v
    e = 1.0 / stretch
    a2 = a * a
    for k in range(count):
        y = lines[Y, k]
        x0 = lines[CELL_X, k]
        rim = a2 - y * y
        q = u - w * y
        root = math.sqrt(max(stretch * rim - q * q, 0.0))
        # A root under the base plane is no edge: there the rim is.
        edge = math.sqrt(max(rim, 0.0))
        left = (v * q - root) * e
        right = (v * q + root) * e
        left = -edge if q < v * left else left
        right = edge if q < v * right else right
        left = max(left, x0)
        right = min(right, x0 + pitch_x)
        width = max(right - left, 0.0)
        left += width * lines[PART_FROM, k]
        width *= lines[PART, k]
        xa = left + width * NEAR
        xb = left + width * FAR
        ga = 1.0 / math.sqrt(max(rim - xa * xa, 1e-9 * a2))
        gb = 1.0 / math.sqrt(max(rim - xb * xb, 1e-9 * a2))
        weight = lines[STRIP, k] * width
        half = 0.5 * weight
        # Under the base plane the strain stays 1.
        ga = ga if q > v * xa else 0.0
        gb = gb if q > v * xb else 0.0
        face_a = (q - v * xa) * ga
        face_b = (q - v * xb) * gb
        lines[AREA, k] = weight
        lines[LINE_G, k] = half * (ga + gb)
        lines[LINE_X, k] = half * (xa * ga + xb * gb)
        lines[LINE_Y, k] = half * y * (ga + gb)
        lines[LINE_SQUARE, k] = half * (face_a * face_a + face_b * face_b)


@kernel
def flush(
    lines: FloatArray,
    owners: IntArray,
    count: int,
    waiting: int,
    u: float,
    v: float,
    w: float,
    a: float,
    pitch_x: float,
    pitch_y: float,
    packed: FloatArray,
) -> None:
    """Sum the lines of the ``waiting`` cut cells into their places in ``packed``.

    ``owners`` [2, waiting] are each cell's place and the end of its lines.
    """
    integrate_lines(lines, count, u, v, w, a, pitch_x)
    whole = 1.0 / (pitch_x * pitch_y)
    line = 0
    for k in range(waiting):
        area = g = g_x = g_y = square = 0.0
        while line < owners[1, k]:
            area += lines[AREA, line]
            g += lines[LINE_G, line]
            g_x += lines[LINE_X, line]
            g_y += lines[LINE_Y, line]
            square += lines[LINE_SQUARE, line]
            line += 1
        place = owners[0, k]
        area *= whole
        if area > 1e-9:
            g *= whole
            g_x *= whole
            g_y *= whole
            face = u * g - v * g_x - w * g_y
            packed[SHARE, place] = area
            packed[PLAIN, place] = g
            packed[ALONG_X, place] = g_x
            packed[ALONG_Y, place] = g_y
            # The strain's variance is that of the face's height times g.
            packed[VARIANCE, place] = (square * whole - face * face / area) / area
        else:
            packed[SHARE, place] = 1.0
            packed[PLAIN, place] = 0.0
            packed[ALONG_X, place] = 0.0
            packed[ALONG_Y, place] = 0.0
            packed[VARIANCE, place] = 0.0
            packed[WEIGHT, place] = 0.0


@kernel
def push_lines(
    lines: FloatArray,
    count: int,
    x0: float,
    y0: float,
    y1: float,
    low: float,
    high: float,
    crossings: Crossings,
    level: int,
) -> int:
    """Cut a cell into strips where the outline crosses its sides; adds the strips' lines.

    ``low``, ``high`` bound the footprint in y; ``crossings`` are the four y where the outline
    crosses the cell's left and right side. ``level`` says how near the rim the cell is.
    """
    start = max(y0, low)
    stop = min(y1, high)
    if not start < stop:
        return count
    b0 = min(max(crossings[0], start), stop)
    b1 = min(max(crossings[1], start), stop)
    b2 = min(max(crossings[2], start), stop)
    b3 = min(max(crossings[3], start), stop)
    b0, b1 = min(b0, b1), max(b0, b1)
    b2, b3 = min(b2, b3), max(b2, b3)
    b0, b2 = min(b0, b2), max(b0, b2)
    b1, b3 = min(b1, b3), max(b1, b3)
    b1, b2 = min(b1, b2), max(b1, b2)
    ends = (b0, b1, b2, b3, stop)
    n = 2 * level + 2  # 2, 4, 6 lines a strip
    parts = 1 << level  # 1, 2, 4 parts a line
    side = 1 if x0 < 0.0 else 0
    for piece in range(5):
        length = ends[piece] - start
        if length > 1e-6 * (y1 - y0):
            for k in range(n):
                y = start + length * GAUSS_NODES[n, k]
                weight = length * GAUSS_WEIGHTS[n, k]
                for m in range(parts):
                    lines[Y, count] = y
                    lines[CELL_X, count] = x0
                    lines[STRIP, count] = weight
                    lines[PART_FROM, count] = PART_STARTS[side, level, m]
                    lines[PART, count] = PART_LENGTHS[side, level, m]
                    count += 1
            start = ends[piece]
    return count
