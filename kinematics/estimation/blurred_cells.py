"""The footprint's cells under a blur: the packed pieces of cells blurred and averaged, as kernels.

The fit models a blurred grid on half cells, or on whole ones if that will do; see pressure_grid.py.
"""

from __future__ import annotations

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import IntPointer, Pointer, further
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
    """Return a cell's weights over the pieces of cells, float64 [n], averaged over its own.

    They begin at the piece with the cell's own number times ``pieces``.
    """
    return np.convolve(stencil, np.full(pieces, 1.0 / pieces))


@fast_inner_kernel
def _clear(out: Pointer, first: int, last: int) -> None:
    for k in range(first, last):
        out[k] = 0.0


@fast_inner_kernel
def _add(weight: float, source: Pointer, step: int, count: int, out: Pointer) -> None:
    for k in range(count):
        out[k] += weight * source[step * k]


@fast_inner_kernel
def _read(row: Pointer, active: Pointer, scale: float, n: int, size: int, out: Pointer) -> None:
    for j in range(n):
        reading = row[j] * scale
        out[READING * size + j] = reading if active[j] > 0.0 else 0.0
        out[WEIGHT * size + j] = active[j]


@fast_inner_kernel
def _locate(state: EstimatorState, indices: IntPointer) -> tuple[int, int, int, int]:
    """Turn ``indices`` into flat ones of the model's grid; return the box they lie in."""
    low = left = 1 << 30
    high = right = 0
    for k in range(state.fit.count):
        i = indices[k] >> INDEX_BITS
        j = indices[k] & ((1 << INDEX_BITS) - 1)
        low = min(low, i)
        high = max(high, i + 1)
        left = min(left, j)
        right = max(right, j + 1)
        indices[k] = i * state.model.cols + j
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
    width = state.model.cols
    size = state.model.rows * width
    cols = state.grid.cols
    pieces_x = blur.pieces_x
    pieces_y = blur.pieces_y
    low, high, left, right = _locate(state, indices)
    first = max((left - blur.weights_x + pieces_x) // pieces_x, 0)
    last = min((right - 1) // pieces_x + 1, cols)
    bottom = max((low - blur.weights_y + pieces_y) // pieces_y, 0)
    top = min((high - 1) // pieces_y + 1, state.grid.rows)
    wide = last - first
    packed = further(scratch, state.at.packed)
    source = further(scratch, state.at.fine)
    between = further(scratch, state.at.half)
    across = further(scratch, state.at.across)
    along = further(scratch, state.at.along)
    _clear(between, 0, width)
    for plane in range(PLANES):
        _clear(source, low * width, high * width)
        for k in range(state.fit.count):
            source[indices[k]] = packed[plane * size + k]
        for i in range(bottom, top):
            out = further(packed, plane * size + (i - bottom) * wide)
            _clear(between, left, right)
            for row in range(max(pieces_y * i, low), min(pieces_y * i + blur.weights_y, high)):
                start = further(source, row * width + left)
                weight = along[row - pieces_y * i]
                _add(weight, start, 1, right - left, further(between, left))
            _clear(out, 0, wide)
            for k in range(blur.weights_x):
                _add(across[k], further(between, pieces_x * first + k), pieces_x, wide, out)
    cells = further(scratch, state.at.cells)
    for i in range(bottom, top):
        active = further(cells, (i * CELL_PLANES + ACTIVE) * cols + first)
        out = further(packed, (i - bottom) * wide)
        _read(further(frame, i * cols + first), active, state.signal.scale, wide, size, out)
    state.fit.count = (top - bottom) * wide
