"""The footprint's cells, gathered from the grid for the likelihood, as kernels.

Cells that lie in the footprint take their means from the grid's planes (cells.py); those that the
outline cuts are integrated (cut_cells.py). No material and no pressure model enters here.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.estimation.blurred_cells import PLACE_BITS
from softfinger.kinematics.estimation.cut_cells import (
    ALONG_X,
    ALONG_Y,
    COARSE,
    FILLED,
    FINE,
    FINEST,
    LEVELS,
    OWNERS,
    PLAIN,
    READING,
    SHARE,
    STRIPS,
    STRIPS_A_CELL,
    VARIANCE,
    WAITING,
    WEIGHT,
    flush,
    push_strips,
)
from softfinger.kinematics.sensing.cell_integrals import (
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
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    band_columns,
    extremes,
    line_spans,
)


@inner_kernel
def pack(
    u: float,
    v: float,
    w: float,
    geometry: Geometry,
    cells: FloatArray,
    frame: FloatArray,
    scale: float,
    bent: bool,
    columns: FloatArray,
    lines: FloatArray,
    strips: FloatArray,
    queues: IntArray,
    owners: IntArray,
    packed: FloatArray,
    places: IntArray,
) -> int:
    """Gather the footprint's cells into ``packed`` [PLANES, n]; returns n.

    ``cells`` [rows, CELL_PLANES, cols] is what :func:`estimation.cell_integrals.face_integrals`
    gives. ``bent``: the strain's variance is wanted, too. ``places`` takes the cells' rows and
    columns, see :func:`estimation.blurred_cells.spread`, unless it is empty. ``columns``
    [2, cols + 1], ``lines`` [2, rows + 1], ``strips``, ``queues`` and ``owners`` are scratch.
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
    line_spans(u, w, v, a, x_first, pitch_x, j0, j1, columns[0], columns[1])
    line_spans(u, v, w, a, y_first, pitch_y, first_row, last_row, lines[0], lines[1])
    # The outline's lowest point over the base plane: where it comes near to the rim.
    cosine2 = 1.0 / (1.0 + v * v + w * w)
    rho2 = max(a * a - u * u * cosine2, 0.0)
    low = u * cosine2 - math.sqrt(rho2 * (1.0 - cosine2)) < 0.2 * a
    placed = places.shape[0] > 0
    count = 0
    for i in range(first_row, last_row):
        y0 = y_first + i * pitch_y
        y1 = y0 + pitch_y
        first, inner_first, inner_last, last = band_columns(
            u,
            v,
            w,
            a,
            ends,
            (lines[0, i], lines[1, i]),
            (lines[0, i + 1], lines[1, i + 1]),
            y0,
            y1,
            x_first,
            pitch_x,
            cols,
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
                crossings = (columns[0, j], columns[1, j], columns[0, j + 1], columns[1, j + 1])
                filled = push_strips(
                    strips[level], queues[level, FILLED], x0, y0, y1, ends[0], ends[1], crossings
                )
                queues[level, FILLED] = filled
                live = cells[i, LIVE, j]
                packed[READING, count] = frame[i, j] * scale if live > 0.0 else 0.0
                packed[WEIGHT, count] = live
                if placed:
                    places[count] = (i << PLACE_BITS) | j
                waiting = queues[level, WAITING]
                owners[level, 0, waiting] = count
                owners[level, 1, waiting] = filled
                queues[level, WAITING] = waiting + 1
                count += 1
                if filled > STRIPS - STRIPS_A_CELL - 8 or waiting + 1 == OWNERS:
                    flush(
                        strips[level],
                        owners[level],
                        queues[level],
                        level,
                        u,
                        v,
                        w,
                        a,
                        pitch_x,
                        pitch_y,
                        packed,
                    )
        n = inner_last - inner_first
        if n > 0:
            if placed:
                for k in range(n):
                    places[count + k] = (i << PLACE_BITS) | (inner_first + k)
            copy_whole(
                cells[i, :, inner_first:inner_last],
                frame[i, inner_first:inner_last],
                scale,
                bent,
                u,
                v,
                w,
                packed[:, count : count + n],
            )
            count += n
    for level in range(LEVELS):
        if queues[level, WAITING] > 0:
            flush(
                strips[level],
                owners[level],
                queues[level],
                level,
                u,
                v,
                w,
                a,
                pitch_x,
                pitch_y,
                packed,
            )
    return count


@fast_inner_kernel
def copy_whole(
    cells: FloatArray,
    row: FloatArray,
    scale: float,
    bent: bool,
    u: float,
    v: float,
    w: float,
    out: FloatArray,
) -> None:
    """Whole cells of one row, planes ``cells`` and readings ``row``, into ``out`` [PLANES, n]."""
    for k in range(row.shape[0]):
        out[SHARE, k] = 1.0
        out[PLAIN, k] = cells[PLAIN_MEAN, k]
        out[ALONG_X, k] = cells[X_MEAN, k]
        out[ALONG_Y, k] = cells[Y_MEAN, k]
        reading = row[k]
        live = cells[LIVE, k]
        out[READING, k] = reading * scale if live > 0.0 else 0.0
        out[WEIGHT, k] = live
    if bent:
        for k in range(row.shape[0]):
            plain = u * cells[PLAIN_VAR, k] - 2.0 * (v * cells[PLAIN_X, k] + w * cells[PLAIN_Y, k])
            out[VARIANCE, k] = (
                u * plain
                + v * (v * cells[X_VAR, k] + 2.0 * w * cells[X_Y, k])
                + w * w * cells[Y_VAR, k]
            )
