"""The footprint's cells under a blur: the packed parts of cells spread and averaged, as kernels.

The fit models a blurred grid on half cells, or on whole ones if that will do; see sensing/blur.py.
"""

from __future__ import annotations

import numpy as np

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address
from softfinger.kinematics.compiled.simd_sums import LANES, further, weighted
from softfinger.kinematics.estimation.cut_cells import READING, WEIGHT
from softfinger.kinematics.sensing.cell_integrals import LIVE
from softfinger.kinematics.sensing.footprint import FloatArray, IntArray

PLANES = 4  # of the fit: stress and its derivatives
PLACE_BITS = 16  # of the column in a place; the row is above


def parts_to_fit(width: float) -> int:
    """Parts that a cell's side is cut into for the fit, 1 or 2, ``width`` in cells.

    Towards the rim the pressure rises like a step, and where in a cell it does so shows in the
    cells beside it.
    """
    return 1 if width == 0.0 or width >= 1.2 else 2


def weights(stencil: FloatArray, parts: int) -> FloatArray:
    """How a cell depends on the ``parts`` of cells, float64 [n], n a multiple of ``parts``.

    From the part on that has the cell's own number times ``parts``: the stencil, averaged over the
    cell's parts, and zeros.
    """
    whole = np.convolve(stencil, np.full(parts, 1.0 / parts))
    return np.pad(whole, (0, -len(whole) % parts))


@fast_inner_kernel
def _clear(out: Pointer, first: int, last: int) -> None:
    for k in range(first, last):
        out[k] = 0.0


@fast_inner_kernel
def _read(row: FloatArray, live: FloatArray, scale: float, out: FloatArray) -> None:
    for j in range(row.shape[0]):
        reading = row[j] * scale
        out[READING, j] = reading if live[j] > 0.0 else 0.0
        out[WEIGHT, j] = live[j]


@fast_inner_kernel
def _locate(
    places: IntArray, count: int, parts_x: int, width: int, phase: int
) -> tuple[int, int, int, int]:
    """Turn ``places`` into those in the scratch of :func:`spread`; the box they lie in.

    There, columns of one remainder by ``parts_x`` stand together: ``phase`` apart.
    """
    shift = 0 if parts_x == 1 else parts_x // 2
    rest = parts_x - 1
    low = left = 1 << 30
    high = right = 0
    for k in range(count):
        i = places[k] >> PLACE_BITS
        j = places[k] & ((1 << PLACE_BITS) - 1)
        low = min(low, i)
        high = max(high, i + 1)
        left = min(left, j)
        right = max(right, j + 1)
        places[k] = i * width + (j & rest) * phase + (j >> shift)
    return low, high, left, right


@inner_kernel
def spread(
    packed: FloatArray,
    count: int,
    places: IntArray,
    frame: FloatArray,
    scale: float,
    cells: FloatArray,
    across: FloatArray,
    along: FloatArray,
    parts_y: int,
    fine: FloatArray,
    half: FloatArray,
) -> int:
    """Blur the first four planes of packed parts of cells, and average them over cells.

    ``places`` [n] are the parts' rows and columns, see PLACE_BITS. ``across`` and ``along`` are
    what :func:`weights` gives. ``packed`` takes all cells of the box as far as the weights reach,
    with readings and weights; their number is returned. ``fine`` [rows of parts + 1, n] and
    ``half`` [n] are scratch, n = parts of a row + weights along x + 2 · LANES · parts.
    """
    if count == 0:
        return 0
    rows, cols = frame.shape
    parts_x = across.shape[0]
    n_x = across.shape[1]
    n_y = along.shape[0]
    width = half.shape[0]
    phase = width // parts_x
    low, high, left, right = _locate(places, count, parts_x, width, phase)
    first = max(left // parts_x - n_x + 1, 0)
    last = min((right - 1) // parts_x + 1, cols)
    bottom = max((low - n_y + parts_y) // parts_y, 0)
    top = min((high - 1) // parts_y + 1, rows)
    wide = last - first
    # The columns of `half` that the box needs, of each phase; what lies right of them is 0.
    ahead = wide + n_x + LANES
    source = address(fine)
    between = address(half)
    for plane in range(PLANES):
        _clear(source, low * width, high * width)
        for k in range(count):
            source[places[k]] = packed[plane, k]
        for i in range(bottom, top):
            start = max(parts_y * i, low)
            number = min(parts_y * i + n_y, high) - start
            out = address(packed[plane, (i - bottom) * wide :])
            _clear(out, 0, wide)
            _clear(between, 0, width)
            for p in range(parts_x):
                at = p * phase + first
                for j in range(at, min(at + ahead, (p + 1) * phase - LANES + 1), LANES):
                    weighted(
                        further(between, j),
                        source,
                        start * width + j,
                        width,
                        address(along),
                        start - parts_y * i,
                        number,
                    )
            for j in range(0, wide, LANES):
                for p in range(parts_x):
                    weighted(
                        further(out, j),
                        between,
                        p * phase + first + j,
                        1,
                        address(across),
                        p * n_x,
                        n_x,
                    )
    for i in range(bottom, top):
        at = (i - bottom) * wide
        _read(frame[i, first:last], cells[i, LIVE, first:last], scale, packed[:, at : at + wide])
    return int((top - bottom) * wide)
