"""The footprint's cells, gathered from the grid for the likelihood, as kernels.

Cells that lie in the footprint take their means from the grid's planes (cell_integrals.py); those
that the outline cuts are integrated (cut_cells.py). No material and no pressure model enters here.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import IntPointer, Pointer, further
from softfinger.kinematics.estimation.cut_cells import (
    COARSE,
    FINE,
    FINEST,
    STRIPS_A_CELL,
    append_strips,
    flush,
)
from softfinger.kinematics.estimation.state import (
    ALONG_X,
    ALONG_Y,
    FRACTION,
    LEVELS,
    OWNERS,
    PLAIN,
    READING,
    STRIPS,
    VARIANCE,
    WEIGHT,
    EstimatorState,
)
from softfinger.kinematics.sensing.cell_integrals import (
    ACTIVE,
    CELL_PLANES,
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
    band_columns,
    cols_touched,
    line_spans,
    rows_touched,
    set_extremes,
)

INDEX_BITS = 16  # of the column in an index; the row is above


@inner_kernel
def pack(
    state: EstimatorState,
    cells: Pointer,
    frame: Pointer,
    scratch: Pointer,
    indices: IntPointer | None,
) -> None:
    """Gather the footprint's cells of the model's grid, their number into ``state.fit.count``.

    ``cells`` are the planes of `sensing.cell_integrals`, ``frame`` the readings. ``indices`` takes
    the cells' rows and columns for :func:`estimation.blurred_cells.blur_cells`.
    """
    fit = state.fit
    face = fit.face
    grid = state.model
    a = grid.radius
    cols = grid.cols
    size = grid.rows * cols
    fit.count = 0
    set_extremes(face, a)
    if not face.low < face.high:
        return
    first_row, last_row = rows_touched(face, grid)
    j0, j1 = cols_touched(face, grid)
    left = further(scratch, state.at.columns)
    right = further(left, cols + 1)
    line_spans(face, grid, True, j0, j1, left, right)
    low = further(scratch, state.at.lines)
    high = further(low, grid.rows + 1)
    line_spans(face, grid, False, first_row, last_row, low, high)
    packed = further(scratch, state.at.packed)
    scale = state.signal.scale
    low_edge = _is_low(state)
    count = 0
    for i in range(first_row, last_row):
        y0 = grid.y + i * grid.pitch_y
        y1 = y0 + grid.pitch_y
        first, inner_first, inner_last, last = band_columns(
            face, grid, (low[i], high[i]), (low[i + 1], high[i + 1]), y0, y1
        )
        first = max(first, j0)
        last = min(last, j1)
        y_far = max(-y0, y1)
        row = further(cells, i * CELL_PLANES * cols)
        readings = further(frame, i * cols)
        for side in range(2):
            begin = first if side == 0 else max(inner_last, first)
            stop = min(inner_first, last) if side == 0 else last
            for j in range(begin, stop):
                x0 = grid.x + j * grid.pitch_x
                x_far = max(-x0, x0 + grid.pitch_x)
                far2 = x_far * x_far + y_far * y_far
                level = COARSE
                if far2 > 0.81 * a * a:
                    level = FINEST if low_edge and far2 > 0.97 * a * a else FINE
                strips = state.strips[level]
                crossings = (left[j], right[j], left[j + 1], right[j + 1])
                append_strips(strips, x0, max(y0, face.low), min(y1, face.high), y1 - y0, crossings)
                active = row[ACTIVE * cols + j]
                packed[READING * size + count] = readings[j] * scale if active > 0.0 else 0.0
                packed[WEIGHT * size + count] = active
                if indices is not None:
                    indices[count] = (i << INDEX_BITS) | j
                strips.indices[strips.owners] = count
                strips.ends[strips.owners] = strips.count
                strips.owners += 1
                count += 1
                if strips.count > STRIPS - STRIPS_A_CELL - 8 or strips.owners == OWNERS:
                    flush(state, level, packed)
        n = inner_last - inner_first
        if n > 0:
            if indices is not None:
                for k in range(n):
                    indices[count + k] = (i << INDEX_BITS) | (inner_first + k)
            _copy_whole(
                state,
                further(row, inner_first),
                further(readings, inner_first),
                n,
                further(packed, count),
            )
            count += n
    for level in range(LEVELS):
        if state.strips[level].owners > 0:
            flush(state, level, packed)
    fit.count = count


@inner_kernel
def _is_low(state: EstimatorState) -> bool:
    """Return whether the outline's lowest point over the base plane comes near to the rim."""
    face = state.fit.face
    a = state.model.radius
    cosine2 = 1.0 / (1.0 + face.v * face.v + face.w * face.w)
    rho2 = max(a * a - face.u * face.u * cosine2, 0.0)
    return face.u * cosine2 - math.sqrt(rho2 * (1.0 - cosine2)) < 0.2 * a


@fast_inner_kernel
def _copy_whole(state: EstimatorState, cells: Pointer, row: Pointer, n: int, out: Pointer) -> None:
    """``n`` whole cells, planes from ``cells`` and readings from ``row`` on, into ``out``."""
    cols = state.model.cols
    size = state.model.rows * cols
    scale = state.signal.scale
    u = state.fit.face.u
    v = state.fit.face.v
    w = state.fit.face.w
    for k in range(n):
        out[FRACTION * size + k] = 1.0
        out[PLAIN * size + k] = cells[PLAIN_MEAN * cols + k]
        out[ALONG_X * size + k] = cells[X_MEAN * cols + k]
        out[ALONG_Y * size + k] = cells[Y_MEAN * cols + k]
        reading = row[k]
        active = cells[ACTIVE * cols + k]
        out[READING * size + k] = reading * scale if active > 0.0 else 0.0
        out[WEIGHT * size + k] = active
    if state.law.bent:
        for k in range(n):
            plain = u * cells[PLAIN_VAR * cols + k] - 2.0 * (
                v * cells[PLAIN_X * cols + k] + w * cells[PLAIN_Y * cols + k]
            )
            out[VARIANCE * size + k] = (
                u * plain
                + v * (v * cells[X_VAR * cols + k] + 2.0 * w * cells[X_Y * cols + k])
                + w * w * cells[Y_VAR * cols + k]
            )
