"""Normal equations of the pressure grid's likelihood, as kernels.

The model of a cell is ``γ · mean(σ(ε)) = γ A (σ(ε̄) + ½ σ''(ε̄) V)``, with A the cell's share in the
footprint, ε̄ and V the strain's mean and variance over that share; it is exact for a constant
modulus, and to the strain's third moment for any other law. The strain is linear in (u, v, w) (see
footprint.py), so its means are sums of fixed means of g, x g, y g for whole cells; cut cells are
integrated (cut_cells.py). The outline adds no derivative of its own, as σ is 0 there.
"""

from __future__ import annotations

import math

import numpy as np

from kinematics.cells import (
    LIVE,
    PLAIN_MEAN,
    PLAIN_VAR,
    PLAIN_X,
    PLAIN_Y,
    X_MEAN,
    X_VAR,
    X_Y,
    Y_MEAN,
    Y_VAR,
)
from kinematics.cut_cells import (
    ALONG_X,
    ALONG_Y,
    COARSE,
    FINE,
    FINEST,
    LINES_A_CELL,
    PLAIN,
    READING,
    SHARE,
    VARIANCE,
    WEIGHT,
    flush,
    push_lines,
)
from kinematics.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    band_columns,
    extremes,
    line_span,
)
from kinematics.kernels import fast_kernel, kernel

SUMS = 17

# A cell that can't read below 0 reads more than the pressure on average, by E[max(z + e, 0)] − z
# standard deviations at a pressure of z, e ~ N(0, 1). Fitted as (1 − z/CLIP_END)² times this
# polynomial, within 3e-4.
CLIP_END = 3.5
CLIP = (0.399207, -0.275277, 0.0188358, 0.0260713, -0.00538491)
LAW_PIECES = 128


def cubic_law(law: FloatArray) -> FloatArray:
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
def pack(
    u: float,
    v: float,
    w: float,
    geometry: Geometry,
    cells: FloatArray,
    frame: FloatArray,
    scale: float,
    columns: FloatArray,
    lines: FloatArray,
    owners: IntArray,
    packed: FloatArray,
) -> int:
    """Gather the footprint's cells into ``packed`` [PLANES, n]; returns n.

    ``cells`` [rows, CELL_PLANES, cols] is what :func:`kinematics.cells.face_integrals` gives;
    ``columns`` [cols + 1, 2], ``lines`` and ``owners`` are scratch, see :class:`Scratch`.
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
    capacity = lines.shape[1] - LINES_A_CELL
    # The outline's lowest point over the base plane: where it comes near to the rim.
    cosine2 = 1.0 / (1.0 + v * v + w * w)
    rho2 = max(a * a - u * u * cosine2, 0.0)
    low = u * cosine2 - math.sqrt(rho2 * (1.0 - cosine2)) < 0.2 * a
    count = 0
    line = 0
    waiting = 0
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
        y_far = max(-y0, y1)
        for side in range(2):
            begin = first if side == 0 else max(inner_last, first)
            stop = min(inner_first, last) if side == 0 else last
            for j in range(begin, stop):
                x0 = x_first + j * pitch_x
                x_far = max(-x0, x0 + pitch_x)
                far2 = x_far * x_far + y_far * y_far
                level = COARSE
                if far2 > 0.81 * a * a:
                    level = FINEST if low and far2 > 0.97 * a * a else FINE
                crossings = (columns[j, 0], columns[j, 1], columns[j + 1, 0], columns[j + 1, 1])
                line = push_lines(lines, line, x0, y0, y1, ends[0], ends[1], crossings, level)
                live = cells[i, LIVE, j]
                packed[READING, count] = frame[i, j] * scale if live > 0.0 else 0.0
                packed[WEIGHT, count] = live
                owners[0, waiting] = count
                owners[1, waiting] = line
                waiting += 1
                count += 1
                if line > capacity or waiting == owners.shape[1]:
                    flush(lines, owners, line, waiting, u, v, w, a, pitch_x, pitch_y, packed)
                    line = 0
                    waiting = 0
        n = inner_last - inner_first
        if n > 0:
            copy_whole(
                cells[i, :, inner_first:inner_last],
                frame[i, inner_first:inner_last],
                scale,
                u,
                v,
                w,
                packed[:, count : count + n],
            )
            count += n
    flush(lines, owners, line, waiting, u, v, w, a, pitch_x, pitch_y, packed)
    return count


@fast_kernel
def copy_whole(
    cells: FloatArray, row: FloatArray, scale: float, u: float, v: float, w: float, out: FloatArray
) -> None:
    """Whole cells of one row, planes ``cells`` and readings ``row``, into ``out`` [PLANES, n]."""
    for k in range(row.shape[0]):
        out[SHARE, k] = 1.0
        out[PLAIN, k] = cells[PLAIN_MEAN, k]
        out[ALONG_X, k] = cells[X_MEAN, k]
        out[ALONG_Y, k] = cells[Y_MEAN, k]
        out[VARIANCE, k] = (
            u * (u * cells[PLAIN_VAR, k] - 2.0 * (v * cells[PLAIN_X, k] + w * cells[PLAIN_Y, k]))
            + v * (v * cells[X_VAR, k] + 2.0 * w * cells[X_Y, k])
            + w * w * cells[Y_VAR, k]
        )
        reading = row[k]
        live = cells[LIVE, k]
        out[READING, k] = reading * scale if live > 0.0 else 0.0
        out[WEIGHT, k] = live


@fast_kernel
def footprint_energy(packed: FloatArray, count: int) -> tuple[float, float]:
    """Σ W p² [Pa²] and Σ W over the packed cells."""
    energy = 0.0
    number = 0.0
    for k in range(count):
        weight = packed[WEIGHT, k]
        energy += weight * packed[READING, k] * packed[READING, k]
        number += weight
    return energy, number


@fast_kernel
def accumulate(
    packed: FloatArray,
    count: int,
    u: float,
    v: float,
    w: float,
    gain: float,
    saturation: float,
    floor: float,
    clip: float,
    law: FloatArray,
    sums: FloatArray,
) -> None:
    """Sums for one Gauss-Newton step over the packed cells, into ``sums`` [17].

    Columns of the Jacobian are (mean stress, σ' g, σ' x g, σ' y g), that is ∂/∂gain and, but for a
    factor ∓gain, ∂/∂(u, v, w): sums[0:10] is the upper triangle of JᵀWJ by rows, sums[10:14] JᵀWr,
    sums[14] rᵀWr, sums[15] yᵀWy, sums[16] ΣW. A full cell counts only while the model stays
    below its end. A cell that the model puts below ``floor`` [Pa] doesn't count, as the board
    sends 0 for it, and no reading is less; −inf for none. ``clip`` > 0 is the noise of cells that
    can't read below 0 [Pa].
    """
    pieces = law.shape[0] - 1
    clipped = 1.0 if clip > 0.0 else 0.0
    per_clip = 1.0 / clip if clip > 0.0 else 0.0
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
        z = min(model * per_clip, CLIP_END)
        above = 1.0 - z / CLIP_END
        base = CLIP[0] + z * (CLIP[1] + z * (CLIP[2] + z * (CLIP[3] + z * CLIP[4])))
        rise = CLIP[1] + z * (2.0 * CLIP[2] + z * (3.0 * CLIP[3] + z * 4.0 * CLIP[4]))
        residual = max(reading, floor) - model - clip * above * above * base
        response = 1.0 + clipped * above * (above * rise - 2.0 / CLIP_END * base)
        full = (reading >= saturation and model >= saturation) or model < floor
        squares = weight * reading * reading
        weight = 0.0 if full else weight
        stress *= response
        slope *= response
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
        yy += squares
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
