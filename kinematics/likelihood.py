"""Normal equations of the pressure grid's likelihood, as kernels.

The model of a cell is ``γ · mean(σ(ε)) = γ A (σ(ε̄) + ½ σ''(ε̄) V)``, with A the cell's share inside the
footprint, ε̄ and V the strain's mean and variance over that share; it is exact for a constant
modulus, and to the strain's third moment for any other law. The strain is linear in (u, v, w) (see
footprint.py), so its means are sums of fixed means of g, x g, y g for whole cells; cut cells are
integrated. The outline adds no derivative of its own, as σ is 0 there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kinematics.footprint import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    band_columns,
    extremes,
    line_span,
)
from kinematics.kernels import fast_kernel, kernel

# Planes of the packed footprint cells: share, means of g, x g, y g, variance of strain, reading,
# weight.
SHARE, PLAIN, ALONG_X, ALONG_Y, VARIANCE, READING, WEIGHT = range(7)
PLANES = 7

LAW_PIECES = 128


def cubic_law(law: NDArray[np.float64]) -> NDArray[np.float64]:
    """Any material's law as LAW_PIECES cubics [pieces + 1, 4] of value, slope at the pieces' ends.

    Piece k holds the coefficients of t = ε·pieces − k. Within 1e-9 of a smooth law; the last row
    continues it linearly.
    """
    pieces, order = law.shape
    strain = np.linspace(0.0, 1.0, LAW_PIECES + 1)
    index = np.minimum((strain * pieces).astype(int), pieces - 1)
    t = strain * pieces - index
    value = np.zeros_like(strain)
    slope = np.zeros_like(strain)
    for j in range(order - 1, -1, -1):
        slope = slope * t + value
        value = value * t + law[index, j]
    slope *= pieces / LAW_PIECES
    table = np.zeros((LAW_PIECES + 1, 4))
    table[:, 0] = value
    table[:, 1] = slope
    rise = np.diff(value)
    table[:-1, 2] = 3.0 * rise - 2.0 * slope[:-1] - slope[1:]
    table[:-1, 3] = slope[:-1] + slope[1:] - 2.0 * rise
    return table


@kernel
def cut_cell(u, v, w, a, x0, x1, y0, y1, low, high, crossings, n):
    """Integrals over the share of a cell in the footprint: (area, g, x g, y g, ε²).

    ``low``, ``high`` bound the footprint in y; ``crossings`` are the four y where the outline crosses
    the cell's sides; ``n`` Gauss points in each direction.
    """
    start = max(y0, low)
    stop = min(y1, high)
    area = plain = along_x = along_y = square = 0.0
    if not start < stop:
        return area, plain, along_x, along_y, square
    b0 = min(max(crossings[0], start), stop)
    b1 = min(max(crossings[1], start), stop)
    b2 = min(max(crossings[2], start), stop)
    b3 = min(max(crossings[3], start), stop)
    if b0 > b1:
        b0, b1 = b1, b0
    if b2 > b3:
        b2, b3 = b3, b2
    b0, b2 = min(b0, b2), max(b0, b2)
    b1, b3 = min(b1, b3), max(b1, b3)
    if b1 > b2:
        b1, b2 = b2, b1
    ends = (b0, b1, b2, b3, stop)
    e = 1.0 + v * v
    for piece in range(5):
        end = ends[piece]
        length = end - start
        if length > 1e-7 * (y1 - y0):
            for k in range(n):
                y = start + length * GAUSS_NODES[n, k]
                rim = a * a - y * y
                q = u - w * y
                root = e * rim - q * q
                if root <= 0.0:
                    continue
                root = math.sqrt(root)
                left = max((v * q - root) / e, x0)
                width = min((v * q + root) / e, x1) - left
                if width <= 0.0:
                    continue
                weight = GAUSS_WEIGHTS[n, k] * length * width
                line = line_x = line_square = 0.0
                for m in range(n):
                    x = left + width * GAUSS_NODES[n, m]
                    g = GAUSS_WEIGHTS[n, m] / math.sqrt(rim - x * x)
                    line += g
                    line_x += g * x
                    face = (q - v * x) * g
                    line_square += face * face / GAUSS_WEIGHTS[n, m]
                area += weight
                plain += weight * line
                along_x += weight * line_x
                along_y += weight * line * y
                # ∫ε² = ∫1 − 2 face g + (face g)²
                square += weight * (1.0 - 2.0 * (q * line - v * line_x) + line_square)
        start = end
    return area, plain, along_x, along_y, square


@kernel
def pack(u, v, w, geometry, cells, frame, scale, columns, packed):
    """Gather the footprint's cells into ``packed`` [PLANES, n]; returns n.

    ``cells`` [rows, 4, cols] holds the means of g, x g, y g over whole cells and 1 for a live cell;
    ``columns`` [cols + 1, 2] is scratch for the outline's crossings of the grid's lines of constant x.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    rows, cols = frame.shape
    ends = extremes(u, v, w, a)
    if not ends[0] < ends[1]:
        return 0
    first_row = min(max(math.floor((ends[0] - y_first) / pitch_y), 0), rows)
    last_row = min(max(math.ceil((ends[1] - y_first) / pitch_y), first_row), rows)
    j0 = min(max(math.floor((ends[3] - x_first) / pitch_x), 0), cols)
    j1 = min(max(math.ceil((ends[5] - x_first) / pitch_x), j0), cols)
    for j in range(j0, j1 + 1):
        columns[j, 0], columns[j, 1] = line_span(u, w, v, a, x_first + j * pitch_x)
    whole = pitch_x * pitch_y
    across_x = pitch_x * pitch_x / 12.0
    across_y = pitch_y * pitch_y / 12.0
    count = 0
    above = line_span(u, v, w, a, y_first + first_row * pitch_y)
    for i in range(first_row, last_row):
        y0 = y_first + i * pitch_y
        y1 = y0 + pitch_y
        below = above
        above = line_span(u, v, w, a, y1)
        first, inner_first, inner_last, last = band_columns(
            u, v, w, a, ends, below, above, y0, y1, x_first, pitch_x, cols
        )
        first = max(first, j0)
        last = min(last, j1)
        for side in range(2):
            begin = first if side == 0 else max(inner_last, first)
            stop = min(inner_first, last) if side == 0 else last
            for j in range(begin, stop):
                x0 = x_first + j * pitch_x
                x1 = x0 + pitch_x
                far = max(abs(x0), abs(x1)) ** 2 + max(abs(y0), abs(y1)) ** 2
                n = 3 if far < 0.81 * a * a else 5
                crossings = (columns[j, 0], columns[j, 1], columns[j + 1, 0], columns[j + 1, 1])
                area, plain, along_x, along_y, square = cut_cell(
                    u, v, w, a, x0, x1, y0, y1, ends[0], ends[1], crossings, n
                )
                if area <= 1e-9 * whole:
                    continue
                mean = (area - u * plain + v * along_x + w * along_y) / area
                packed[0, count] = area / whole
                packed[1, count] = plain / whole
                packed[2, count] = along_x / whole
                packed[3, count] = along_y / whole
                packed[4, count] = square / area - mean * mean
                packed[5, count] = frame[i, j] * scale
                packed[6, count] = cells[i, 3, j]
                count += 1
        n = inner_last - inner_first
        if n > 0:
            for k in range(n):
                j = inner_first + k
                g = cells[i, 0, j]
                g_x = cells[i, 1, j]
                g_y = cells[i, 2, j]
                face = u * g - v * g_x - w * g_y
                slope_x = v * g - face * g_x * g
                slope_y = w * g - face * g_y * g
                packed[0, count + k] = 1.0
                packed[1, count + k] = g
                packed[2, count + k] = g_x
                packed[3, count + k] = g_y
                packed[4, count + k] = slope_x * slope_x * across_x + slope_y * slope_y * across_y
                packed[5, count + k] = frame[i, j] * scale
                packed[6, count + k] = cells[i, 3, j]
            count += n
    return count


@fast_kernel
def accumulate(packed, count, u, v, w, gain, saturation, law, sums):
    """Sums for one Gauss-Newton step over the packed cells, into ``sums`` [17].

    Columns of the Jacobian are (mean stress, σ' g, σ' x g, σ' y g), that is ∂/∂gain and, but for a
    factor ∓gain, ∂/∂(u, v, w): sums[0:10] is the upper triangle of JᵀWJ by rows, sums[10:14] JᵀWr,
    sums[14] rᵀWr, sums[15] yᵀWy, sums[16] ΣW. A saturated cell counts only while the model stays below.
    """
    pieces = law.shape[0] - 1
    s00 = s01 = s02 = s03 = s11 = s12 = s13 = s22 = s23 = s33 = 0.0
    r0 = r1 = r2 = r3 = rr = yy = ww = 0.0
    for k in range(count):
        share = packed[0, k]
        g = packed[1, k]
        g_x = packed[2, k]
        g_y = packed[3, k]
        t = (1.0 - (u * g - v * g_x - w * g_y) / share) * pieces
        t = min(max(t, 0.0), float(pieces))
        piece = np.int32(t)
        t -= piece
        c1 = law[piece, 1]
        c2 = law[piece, 2]
        c3 = law[piece, 3]
        stress = law[piece, 0] + t * (c1 + t * (c2 + t * c3))
        slope = (c1 + t * (2.0 * c2 + t * 3.0 * c3)) * pieces
        bend = (2.0 * c2 + 6.0 * t * c3) * pieces * pieces
        stress = share * (stress + 0.5 * bend * packed[4, k])
        reading = packed[5, k]
        weight = packed[6, k]
        model = gain * stress
        weight = 0.0 if (reading >= saturation and model >= saturation) else weight
        residual = reading - model
        a1 = slope * g
        a2 = slope * g_x
        a3 = slope * g_y
        w0 = weight * stress
        w1 = weight * a1
        w2 = weight * a2
        w3 = weight * a3
        s00 += w0 * stress
        s01 += w0 * a1
        s02 += w0 * a2
        s03 += w0 * a3
        s11 += w1 * a1
        s12 += w1 * a2
        s13 += w1 * a3
        s22 += w2 * a2
        s23 += w2 * a3
        s33 += w3 * a3
        r0 += w0 * residual
        r1 += w1 * residual
        r2 += w2 * residual
        r3 += w3 * residual
        rr += weight * residual * residual
        yy += weight * reading * reading
        ww += weight
    sums[0] = s00
    sums[1] = s01
    sums[2] = s02
    sums[3] = s03
    sums[4] = s11
    sums[5] = s12
    sums[6] = s13
    sums[7] = s22
    sums[8] = s23
    sums[9] = s33
    sums[10] = r0
    sums[11] = r1
    sums[12] = r2
    sums[13] = r3
    sums[14] = rr
    sums[15] = yy
    sums[16] = ww
