"""Cells that the footprint's outline cuts, integrated for the likelihood, as kernels.

A cut cell falls into strips in y where the outline enters or leaves through a side; a strip has two
Gauss lines in y, a line two Gauss points in x, doubled towards the rim; where the outline all but
meets the rim more of them, in parts that shorten towards it, since there g grows like one over a
square root. At a noise of 0.1 % of the modulus that keeps the bias it causes below a fifth of the
noise floor up to 6° from the domain's limit, mostly far below, and below a third up to 3°, at a
third of the cost of the forward model's integrals. Strips of many cells are gathered first and
integrated side by side in SIMD lanes.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.sensing.footprint import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    Crossings,
    FloatArray,
    IntArray,
)

# Planes of the packed footprint cells: share, means of g, x g, y g over it, variance of strain,
# reading, weight.
SHARE, PLAIN, ALONG_X, ALONG_Y, VARIANCE, READING, WEIGHT = range(7)
PLANES = 7

# Rows of the scratch for strips across cut cells, first what goes in: the strip's lower end and
# length, the cell's left side, and 1 where the rim is on the cell's left, else 0. Then the ends of
# the line at work, and the sums that come out.
FROM, LENGTH, CELL_X, SIDE, LEFT, WIDTH, AREA, SUM_G, SUM_X, SUM_Y, SUM_SQUARE = range(11)
STRIP_ROWS = 11
STRIPS_A_CELL = 5
STRIPS = 264  # at once, of each level
OWNERS = 128

# How near the rim a cell is, and where a line's parts end by that, counted from the rim's far side.
COARSE, FINE, FINEST = range(3)
LEVELS = 3
PART_ENDS = np.array(
    [[0.0, 1.0, 1.0, 1.0, 1.0], [0.0, 0.5, 1.0, 1.0, 1.0], [0.0, 0.5, 0.75, 0.9, 1.0]]
)

# Where the queues of strips stand in the integer scratch: strips and cells of each level.
FILLED, WAITING = range(2)

# The two-point Gauss rule on [0, 1].
NEAR = 0.5 - 0.5 / math.sqrt(3.0)
FAR = 0.5 + 0.5 / math.sqrt(3.0)


@fast_inner_kernel
def integrate_strips(
    strips: FloatArray,
    count: int,
    level: int,
    u: float,
    v: float,
    w: float,
    a: float,
    pitch_x: float,
) -> None:
    """Integrals over the footprint's part of each strip of ``strips`` [STRIP_ROWS, n], in lanes.

    In: rows FROM, LENGTH, CELL_X, SIDE. Out: rows AREA, and the integrals of g, x g, y g and
    (face g)², with the face's height over the base.
    """
    stretch = 1.0 + v * v
    e = 1.0 / stretch
    a2 = a * a
    n = 2 * level + 2  # 2, 4, 6 lines
    parts = 1 << level  # 1, 2, 4 parts a line
    for k in range(count):
        strips[AREA, k] = 0.0
        strips[SUM_G, k] = 0.0
        strips[SUM_X, k] = 0.0
        strips[SUM_Y, k] = 0.0
        strips[SUM_SQUARE, k] = 0.0
    for line in range(n):
        node = GAUSS_NODES[n, line]
        share = GAUSS_WEIGHTS[n, line]
        for k in range(count):
            y = strips[FROM, k] + strips[LENGTH, k] * node
            x0 = strips[CELL_X, k]
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
            width = max(min(right, x0 + pitch_x) - left, 0.0)
            strips[LEFT, k] = left
            strips[WIDTH, k] = width
            strips[AREA, k] += share * strips[LENGTH, k] * width
        for part in range(parts):
            start = PART_ENDS[level, part]
            length = PART_ENDS[level, part + 1] - start
            mirrored = 1.0 - 2.0 * start - length
            for k in range(count):
                y = strips[FROM, k] + strips[LENGTH, k] * node
                rim = a2 - y * y
                q = u - w * y
                width = strips[WIDTH, k]
                left = strips[LEFT, k] + width * (start + mirrored * strips[SIDE, k])
                width *= length
                xa = left + width * NEAR
                xb = left + width * FAR
                ga = 1.0 / math.sqrt(max(rim - xa * xa, 1e-9 * a2))
                gb = 1.0 / math.sqrt(max(rim - xb * xb, 1e-9 * a2))
                # Under the base plane the strain stays 1.
                ga = ga if q > v * xa else 0.0
                gb = gb if q > v * xb else 0.0
                face_a = (q - v * xa) * ga
                face_b = (q - v * xb) * gb
                half = 0.5 * share * strips[LENGTH, k] * width
                strips[SUM_G, k] += half * (ga + gb)
                strips[SUM_X, k] += half * (xa * ga + xb * gb)
                strips[SUM_Y, k] += half * y * (ga + gb)
                strips[SUM_SQUARE, k] += half * (face_a * face_a + face_b * face_b)


@inner_kernel
def flush(
    strips: FloatArray,
    owners: IntArray,
    filled: IntArray,
    level: int,
    u: float,
    v: float,
    w: float,
    a: float,
    pitch_x: float,
    pitch_y: float,
    packed: FloatArray,
) -> None:
    """Sum the strips of one level's cut cells into the cells' places in ``packed``; empties it.

    ``strips`` [STRIP_ROWS, n] and ``owners`` [2, OWNERS] are the level's: each cell's place and the
    end of its strips; ``filled`` [2] their numbers.
    """
    # Whole lanes: what is left of earlier strips in the last ones does no harm.
    integrate_strips(strips, (filled[FILLED] + 7) & ~7, level, u, v, w, a, pitch_x)
    whole = 1.0 / (pitch_x * pitch_y)
    strip = 0
    for k in range(filled[WAITING]):
        area = g = g_x = g_y = square = 0.0
        while strip < owners[1, k]:
            area += strips[AREA, strip]
            g += strips[SUM_G, strip]
            g_x += strips[SUM_X, strip]
            g_y += strips[SUM_Y, strip]
            square += strips[SUM_SQUARE, strip]
            strip += 1
        place = owners[0, k]
        share = area * whole
        if share > 1e-9:
            per_area = 1.0 / area
            g *= per_area
            g_x *= per_area
            g_y *= per_area
            face = u * g - v * g_x - w * g_y
            packed[SHARE, place] = share
            packed[PLAIN, place] = g
            packed[ALONG_X, place] = g_x
            packed[ALONG_Y, place] = g_y
            # The strain's variance is that of the face's height times g.
            packed[VARIANCE, place] = square * per_area - face * face
        else:
            packed[SHARE, place] = 0.0
            packed[PLAIN, place] = 0.0
            packed[ALONG_X, place] = 0.0
            packed[ALONG_Y, place] = 0.0
            packed[VARIANCE, place] = 0.0
            packed[WEIGHT, place] = 0.0
    filled[FILLED] = 0
    filled[WAITING] = 0


@inner_kernel
def push_strips(
    strips: FloatArray,
    count: int,
    x0: float,
    y0: float,
    y1: float,
    low: float,
    high: float,
    crossings: Crossings,
) -> int:
    """Cut a cell into strips where the outline crosses its sides; their number with the new ones.

    ``low``, ``high`` bound the footprint in y; ``crossings`` are the four y where the outline
    crosses the cell's left and right side.
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
    side = 1.0 if x0 < 0.0 else 0.0
    least = 1e-6 * (y1 - y0)
    for end in (b0, b1, b2, b3, stop):
        strips[FROM, count] = start
        strips[LENGTH, count] = end - start
        strips[CELL_X, count] = x0
        strips[SIDE, count] = side
        # Written anyway, and kept if it's worth it: no branch that can't be foreseen.
        kept = end - start > least
        count += 1 if kept else 0
        start = end if kept else start
    return count
