"""The footprint's cells under a blur: the packed parts of cells spread and averaged, as kernels.

The fit models a blurred grid on half cells, or on whole ones if that will do; see sensing/blur.py.
"""

from __future__ import annotations

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import STRIDE, IntPointer, Pointer, further, weighted
from softfinger.kinematics.estimation.packing import PLACE_BITS
from softfinger.kinematics.estimation.state import READING, WEIGHT, EstimatorState
from softfinger.kinematics.sensing.cell_integrals import CELL_PLANES, LIVE
from softfinger.kinematics.sensing.footprint import FloatArray

PLANES = 4  # spread: stress and its derivatives


def parts_to_fit(width: float) -> int:
    """Return the pieces that a cell's side is cut into for the fit, 1 or 2; ``width`` in cells.

    Towards the rim the pressure rises like a step, and where in a cell it does so shows in the
    cells beside it.
    """
    return 1 if width == 0.0 or width >= 1.2 else 2


def weights(stencil: FloatArray, parts: int) -> FloatArray:
    """Return a cell's weights over the pieces of cells, float64 [n], n a multiple of ``parts``.

    They begin at the piece with the cell's own number times ``parts``: the stencil, averaged over
    the cell's pieces, and zeros.
    """
    whole = np.convolve(stencil, np.full(parts, 1.0 / parts))
    return np.pad(whole, (0, -len(whole) % parts))


@fast_inner_kernel
def _clear(out: Pointer, first: int, last: int) -> None:
    for k in range(first, last):
        out[k] = 0.0


@fast_inner_kernel
def _read(row: Pointer, live: Pointer, scale: float, n: int, size: int, out: Pointer) -> None:
    for j in range(n):
        reading = row[j] * scale
        out[READING * size + j] = reading if live[j] > 0.0 else 0.0
        out[WEIGHT * size + j] = live[j]


@fast_inner_kernel
def _locate(state: EstimatorState, places: IntPointer) -> tuple[int, int, int, int]:
    """Turn ``places`` into those in the scratch of :func:`spread`; the box they lie in.

    There, columns of one remainder by the parts of a cell stand together.
    """
    width = state.blur.width
    parts_x = state.blur.parts_x
    phase = width // parts_x
    shift = 0 if parts_x == 1 else parts_x // 2
    rest = parts_x - 1
    low = left = 1 << 30
    high = right = 0
    for k in range(state.fit.count):
        i = places[k] >> PLACE_BITS
        j = places[k] & ((1 << PLACE_BITS) - 1)
        low = min(low, i)
        high = max(high, i + 1)
        left = min(left, j)
        right = max(right, j + 1)
        places[k] = i * width + (j & rest) * phase + (j >> shift)
    return low, high, left, right


@inner_kernel
def spread(state: EstimatorState, frame: Pointer, arena: Pointer, places: IntPointer) -> None:
    """Blur the first four planes of packed parts of cells, and average them over cells.

    ``places`` are the parts' rows and columns, see PLACE_BITS. The packed cells are then all cells
    of the box as far as the weights reach, with readings and weights.
    """
    if state.fit.count == 0:
        return
    blur = state.blur
    size = state.model.rows * state.model.cols
    cols = state.grid.cols
    parts_x = blur.parts_x
    parts_y = blur.parts_y
    n_x = blur.weights_x
    n_y = blur.weights_y
    width = blur.width
    phase = width // parts_x
    low, high, left, right = _locate(state, places)
    first = max(left // parts_x - n_x + 1, 0)
    last = min((right - 1) // parts_x + 1, cols)
    bottom = max((low - n_y + parts_y) // parts_y, 0)
    top = min((high - 1) // parts_y + 1, state.grid.rows)
    wide = last - first
    # The columns of ``between`` that the box needs, of each phase; what lies right of them is 0.
    ahead = wide + n_x + STRIDE
    packed = further(arena, state.at.packed)
    source = further(arena, state.at.fine)
    between = further(arena, state.at.half)
    across = further(arena, state.at.across)
    along = further(arena, state.at.along)
    for plane in range(PLANES):
        _clear(source, low * width, high * width)
        for k in range(state.fit.count):
            source[places[k]] = packed[plane * size + k]
        for i in range(bottom, top):
            begin = max(parts_y * i, low)
            number = min(parts_y * i + n_y, high) - begin
            out = further(packed, plane * size + (i - bottom) * wide)
            _clear(out, 0, wide)
            _clear(between, 0, width)
            for p in range(parts_x):
                at = p * phase + first
                for j in range(at, min(at + ahead, (p + 1) * phase - STRIDE + 1), STRIDE):
                    here = further(between, j)
                    skip = begin - parts_y * i
                    weighted(here, source, begin * width + j, width, along, skip, number)
            for j in range(0, wide, STRIDE):
                for p in range(parts_x):
                    at = p * phase + first + j
                    weighted(further(out, j), between, at, 1, across, p * n_x, n_x)
    cells = further(arena, state.at.cells)
    for i in range(bottom, top):
        live = further(cells, (i * CELL_PLANES + LIVE) * cols + first)
        out = further(packed, (i - bottom) * wide)
        _read(further(frame, i * cols + first), live, state.signal.scale, wide, size, out)
    state.fit.count = (top - bottom) * wide
