"""The footprint's cells, gathered from the grid and integrated for the likelihood, as kernels.

Cells that lie in the footprint take their means from the grid's planes (cell_integrals.py). No
material and no pressure model enters here.

A cut cell falls into strips in y where the outline enters or leaves through a side; a strip has two
Gauss lines in y, a line two Gauss points in x, doubled towards the rim; where the outline all but
meets the rim five lines, and three points over the root of the distance to the rim, since there g
grows like one over it. At a noise of 0.1 % of a constant modulus that keeps the bias it causes
below a tenth of the noise floor up to 6° from the domain's limit, and mostly far below, at a third
of the cost of the forward model's integrals. Strips of many cells are gathered first and integrated
side by side in SIMD lanes.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import fast_inner_kernel, inner_kernel
from softfinger.kinematics.compiled.simd import IntPointer, Pointer, further
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
    Strips,
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
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    Face,
    Grid,
    band_columns,
    cols_touched,
    line_spans,
    rows_touched,
    set_extremes,
)

INDEX_BITS = 16  # of the column in an index; the row is above
STRIPS_A_CELL = 5

COARSE, FINE, FINEST = range(3)  # how near the rim a cell is

# The two-point Gauss rule on [0, 1].
NEAR = 0.5 - 0.5 / math.sqrt(3.0)
FAR = 0.5 + 0.5 / math.sqrt(3.0)


@fast_inner_kernel
def _integrate_strips(strips: Strips, level: int, face: Face, grid: Grid) -> None:
    """Area of the footprint's part of each strip, and over it the integrals of g, x g, y g, (z g)².

    z is the face's height over the base. In SIMD lanes.
    """
    u = face.u
    v = face.v
    w = face.w
    pitch_x = grid.pitch_x
    start = strips.start
    length = strips.length
    cell_x = strips.cell_x
    left = strips.left
    width = strips.width
    area = strips.area
    sum_g = strips.sum_g
    sum_x = strips.sum_x
    sum_y = strips.sum_y
    sum_square = strips.sum_square
    # Whole lanes: what is left of earlier strips in the last ones does no harm.
    count = (strips.count + 7) & ~7
    norm2 = 1.0 + v * v
    e = 1.0 / norm2
    a2 = grid.radius * grid.radius
    n = (2, 4, 5)[level]  # lines
    for k in range(count):
        area[k] = 0.0
        sum_g[k] = 0.0
        sum_x[k] = 0.0
        sum_y[k] = 0.0
        sum_square[k] = 0.0
    for line in range(n):
        node = GAUSS_NODES[n, line]
        weight = GAUSS_WEIGHTS[n, line]
        for k in range(count):
            y = start[k] + length[k] * node
            x0 = cell_x[k]
            rim = a2 - y * y
            q = u - w * y
            root = math.sqrt(max(norm2 * rim - q * q, 0.0))
            # A root under the base plane is no edge: there the rim is.
            edge = math.sqrt(max(rim, 0.0))
            near = (v * q - root) * e
            far = (v * q + root) * e
            near = -edge if q < v * near else near
            far = edge if q < v * far else far
            near = max(near, x0)
            across = max(min(far, x0 + pitch_x) - near, 0.0)
            left[k] = near
            width[k] = across
            area[k] += weight * length[k] * across
        if level == FINEST:
            _add_to_the_rim(strips, count, face, a2, node, weight)
            continue
        for section in range(level + 1):
            section_width = 1.0 / (level + 1)
            begin = section * section_width
            for k in range(count):
                y = start[k] + length[k] * node
                rim = a2 - y * y
                q = u - w * y
                across = section_width * width[k]
                near = left[k] + begin * width[k]
                xa = near + across * NEAR
                xb = near + across * FAR
                ga = 1.0 / math.sqrt(max(rim - xa * xa, 1e-9 * a2))
                gb = 1.0 / math.sqrt(max(rim - xb * xb, 1e-9 * a2))
                # Under the base plane the strain stays 1.
                ga = ga if q > v * xa else 0.0
                gb = gb if q > v * xb else 0.0
                face_a = (q - v * xa) * ga
                face_b = (q - v * xb) * gb
                half = 0.5 * weight * length[k] * across
                sum_g[k] += half * (ga + gb)
                sum_x[k] += half * (xa * ga + xb * gb)
                sum_y[k] += half * y * (ga + gb)
                sum_square[k] += half * (face_a * face_a + face_b * face_b)


@fast_inner_kernel
def _add_to_the_rim(
    strips: Strips, count: int, face: Face, a2: float, node: float, line_weight: float
) -> None:
    """One line of each strip, by three Gauss points over s = √(R − x), the rim at x = ±R.

    g dx = −2 ds/√(R + x) is smooth there, as g is not.
    """
    for k in range(count):
        y = strips.start[k] + strips.length[k] * node
        rim = a2 - y * y
        q = face.u - face.w * y
        # Mirrored where the rim is on the left.
        sign = 1.0 - 2.0 * strips.side[k]
        edge = math.sqrt(max(rim, 1e-9 * a2))
        from_rim = edge - sign * strips.left[k]
        across = sign * strips.width[k]
        far = math.sqrt(max(from_rim, 0.0))
        near = math.sqrt(max(from_rim - across, 0.0))
        low = max(min(near, far), 1e-4 * edge)
        span = max(near, far, low) - low
        total = along = square = 0.0
        for point in range(3):
            s = low + span * GAUSS_NODES[3, point]
            x = edge - s * s
            height = q - face.v * sign * x
            g = 1.0 / (s * math.sqrt(max(edge + x, 1e-6 * edge)))
            g = g if height > 0.0 else 0.0
            weight = GAUSS_WEIGHTS[3, point] * s * g
            total += weight
            along += weight * x
            square += weight * g * height * height
        half = 2.0 * line_weight * strips.length[k] * span
        strips.sum_g[k] += half * total
        strips.sum_x[k] += half * sign * along
        strips.sum_y[k] += half * y * total
        strips.sum_square[k] += half * square


@inner_kernel
def flush(state: EstimatorState, level: int, packed: Pointer) -> None:
    """Sum the strips of one level's cut cells into the cells' entries in ``packed``; empties it."""
    strips = state.strips[level]
    grid = state.model
    face = state.fit.face
    size = grid.rows * grid.cols
    _integrate_strips(strips, level, face, grid)
    whole = 1.0 / (grid.pitch_x * grid.pitch_y)
    strip = 0
    for k in range(strips.owners):
        area = g = g_x = g_y = square = 0.0
        while strip < strips.ends[k]:
            area += strips.area[strip]
            g += strips.sum_g[strip]
            g_x += strips.sum_x[strip]
            g_y += strips.sum_y[strip]
            square += strips.sum_square[strip]
            strip += 1
        index = strips.indices[k]
        fraction = area * whole
        variance = 0.0
        if fraction > 1e-9:
            per_area = 1.0 / area
            g *= per_area
            g_x *= per_area
            g_y *= per_area
            height = face.u * g - face.v * g_x - face.w * g_y
            # The strain's variance is that of the face's height times g.
            variance = square * per_area - height * height
        else:
            fraction = g = g_x = g_y = 0.0
            packed[WEIGHT * size + index] = 0.0
        packed[FRACTION * size + index] = fraction
        packed[PLAIN * size + index] = g
        packed[ALONG_X * size + index] = g_x
        packed[ALONG_Y * size + index] = g_y
        packed[VARIANCE * size + index] = variance
    strips.count = 0
    strips.owners = 0


@inner_kernel
def append_strips(
    strips: Strips,
    x0: float,
    start: float,
    stop: float,
    height: float,
    crossings: tuple[float, float, float, float],
) -> None:
    """Cut a cell into strips where the outline crosses its sides.

    ``start`` and ``stop`` are the cell's ends in y within the footprint, ``height`` is the whole
    cell's; ``crossings`` are the four y where the outline crosses its left and right side.
    """
    if not start < stop:
        return
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
    length_min = 1e-6 * height
    count = strips.count
    for end in (b0, b1, b2, b3, stop):
        strips.start[count] = start
        strips.length[count] = end - start
        strips.cell_x[count] = x0
        strips.side[count] = side
        # Written anyway, and kept if it's worth it: no branch that can't be foreseen.
        counts = end - start > length_min
        count += 1 if counts else 0
        start = end if counts else start
    strips.count = count


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
