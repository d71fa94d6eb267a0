"""The footprint's cells under a blur: the packed pieces of cells blurred and averaged, as kernels.

The fit models a blurred grid on half cells, or on whole ones if that will do; see pressure_grid.py.
"""

from __future__ import annotations

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import STRIDE, IntPointer, Pointer, further, weighted
from softfinger.kinematics.estimation.packing import INDEX_BITS
from softfinger.kinematics.estimation.state import READING, WEIGHT, EstimatorState
from softfinger.kinematics.sensing.cell_integrals import ACTIVE, CELL_PLANES
from softfinger.kinematics.sensing.footprint import FloatArray

PLANES = 4  # blurred: stress and its derivatives


def pieces_to_fit(width: float) -> int:
    """Return the pieces that a cell's side is cut into for the fit, 1 or 2; ``width`` in cells.

    Towards the rim the pressure rises like a step, and where in a cell it does so shows in the
    cells beside it.
    """
    return 1 if width == 0.0 or width >= 1.2 else 2


def weights(stencil: FloatArray, pieces: int) -> FloatArray:
    """Return a cell's weights over the pieces of cells, float64 [n], n a multiple of ``pieces``.

    They begin at the piece with the cell's own number times ``pieces``: the stencil, averaged over
    the cell's pieces, and zeros.
    """
    whole = np.convolve(stencil, np.full(pieces, 1.0 / pieces))
    return np.pad(whole, (0, -len(whole) % pieces))


@fast_inner_kernel
def _clear(out: Pointer, first: int, last: int) -> None:
    for k in range(first, last):
        out[k] = 0.0


@fast_inner_kernel
def _read(row: Pointer, active: Pointer, scale: float, n: int, size: int, out: Pointer) -> None:
    for j in range(n):
        reading = row[j] * scale
        out[READING * size + j] = reading if active[j] > 0.0 else 0.0
        out[WEIGHT * size + j] = active[j]


@fast_inner_kernel
def _locate(state: EstimatorState, indices: IntPointer) -> tuple[int, int, int, int]:
    """Turn ``indices`` into those in the scratch of :func:`blur_cells`; the box they lie in.

    There, columns of one remainder by the pieces of a cell stand together.
    """
    width = state.blur.width
    pieces_x = state.blur.pieces_x
    phase = width // pieces_x
    shift = 0 if pieces_x == 1 else pieces_x // 2
    rest = pieces_x - 1
    low = left = 1 << 30
    high = right = 0
    for k in range(state.fit.count):
        i = indices[k] >> INDEX_BITS
        j = indices[k] & ((1 << INDEX_BITS) - 1)
        low = min(low, i)
        high = max(high, i + 1)
        left = min(left, j)
        right = max(right, j + 1)
        indices[k] = i * width + (j & rest) * phase + (j >> shift)
    return low, high, left, right


@inner_kernel
def blur_cells(
    state: EstimatorState, frame: Pointer, scratch: Pointer, indices: IntPointer
) -> None:
    """Blur the first four planes of packed pieces of cells, and average them over cells.

    ``indices`` are the pieces' rows and columns, see INDEX_BITS. The packed cells are then all
    cells of the box as far as the weights extend, with readings and weights.
    """
    if state.fit.count == 0:
        return
    blur = state.blur
    size = state.model.rows * state.model.cols
    cols = state.grid.cols
    pieces_x = blur.pieces_x
    pieces_y = blur.pieces_y
    n_x = blur.weights_x
    n_y = blur.weights_y
    width = blur.width
    phase = width // pieces_x
    low, high, left, right = _locate(state, indices)
    first = max(left // pieces_x - n_x + 1, 0)
    last = min((right - 1) // pieces_x + 1, cols)
    bottom = max((low - n_y + pieces_y) // pieces_y, 0)
    top = min((high - 1) // pieces_y + 1, state.grid.rows)
    wide = last - first
    # The columns of ``between`` that the box needs, of each phase; what lies right of them is 0.
    ahead = wide + n_x + STRIDE
    packed = further(scratch, state.at.packed)
    source = further(scratch, state.at.fine)
    between = further(scratch, state.at.half)
    across = further(scratch, state.at.across)
    along = further(scratch, state.at.along)
    for plane in range(PLANES):
        _clear(source, low * width, high * width)
        for k in range(state.fit.count):
            source[indices[k]] = packed[plane * size + k]
        for i in range(bottom, top):
            begin = max(pieces_y * i, low)
            number = min(pieces_y * i + n_y, high) - begin
            out = further(packed, plane * size + (i - bottom) * wide)
            _clear(out, 0, wide)
            _clear(between, 0, width)
            for p in range(pieces_x):
                at = p * phase + first
                for j in range(at, min(at + ahead, (p + 1) * phase - STRIDE + 1), STRIDE):
                    here = further(between, j)
                    skip = begin - pieces_y * i
                    weighted(here, source, begin * width + j, width, along, skip, number)
            for j in range(0, wide, STRIDE):
                for p in range(pieces_x):
                    at = p * phase + first + j
                    weighted(further(out, j), between, at, 1, across, p * n_x, n_x)
    cells = further(scratch, state.at.cells)
    for i in range(bottom, top):
        active = further(cells, (i * CELL_PLANES + ACTIVE) * cols + first)
        out = further(packed, (i - bottom) * wide)
        _read(further(frame, i * cols + first), active, state.signal.scale, wide, size, out)
    state.fit.count = (top - bottom) * wide
