"""Cheap test of a frame: does anything press on the grid, and can it be one contact?

Kernels on readings and noise alone, without displacement or tilt. Cells that read high alone, as no
contact can make them, are found and masked.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.estimation.cell_centres import next_above, totals
from softfinger.kinematics.estimation.state import OUTLIERS_MAX, Cells, EstimatorState
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Grid,
    line_span,
    set_around,
    set_face,
    steps,
)

_HYSTERESIS = 0.5  # of the level for a first contact: one that is just felt doesn't flicker
STRONG = 6.0  # noise: above it the largest cell is looked at first


@inner_kernel
def neighbourhood(frame: FloatArray, height: FloatArray, grid: Grid, at: int) -> float:
    """Return how far the 5 × 5 cells round the cell ``at``, itself left out, stand above noise 1.

    Weights (1, 2, 2, 2, 1) both ways; the sum over its standard deviation. ``height`` is the plane
    of :mod:`estimation.cell_centres`: cells that are dead or out of reach don't count.
    """
    cols = grid.cols
    i = at // cols
    j = at - i * cols
    total = 0.0
    squares = 1e-30
    for k in range(max(i - 2, 0), min(i + 3, grid.rows)):
        row_weight = 1.0 if abs(k - i) == 2 else 2.0
        for m in range(max(j - 2, 0), min(j + 3, cols)):
            weight = row_weight if abs(m - j) == 2 else 2.0 * row_weight
            counts = (height[k * cols + m] >= 0.0) & ((k != i) | (m != j))
            total += weight * frame[k * cols + m] if counts else 0.0
            squares += weight * weight if counts else 0.0
    return total / math.sqrt(squares)


@inner_kernel
def activity(state: EstimatorState, frame: FloatArray, height: FloatArray) -> None:
    """Test the frame for a contact, cheaply, into ``state.signal``.

    A contact is a cell of ``peak_level`` · noise or more whose neighbours' weighted sum, itself
    left out, passes ``patch_level`` standard deviations: one outlier alone is none. At levels 3 and
    4.9 white noise passes for one in 788 · 1.35e-3 · 4.8e-7 = 5.1e-7 of the frames of 788 cells, a
    cell and its neighbours being independent; d = 0.2 mm under 0.2 % of the modulus as noise is
    seen in 99.98 %, measured over 150 000 frames, all azimuths, tilts up to 30° and positions
    between the cells.
    """
    signal = state.signal
    grid = state.grid
    last = frame.shape[0]
    total, energy, peak = totals(frame, height)
    signal.finite = math.isfinite(total) and math.isfinite(peak)
    signal.peak = peak
    signal.mean = total / max(float(signal.number), 1.0)
    signal.energy = energy
    contact = False
    cell = -1
    level = state.options.peak_level * signal.noise
    patch = signal.patch_level * signal.noise
    if signal.finite and peak >= level:
        if peak > STRONG * signal.noise:
            cell = next_above(frame, height, 0, last, peak)
            contact = neighbourhood(frame, height, grid, cell) > patch
        at = last if contact else next_above(frame, height, 0, last, level)
        while at < last:
            cell = at if frame[at] == peak else cell
            contact = contact or neighbourhood(frame, height, grid, at) > patch
            at = next_above(frame, height, at + 1, last, level)
    signal.contact = contact
    signal.row = cell // grid.cols if cell >= 0 else -1
    signal.col = cell - signal.row * grid.cols if cell >= 0 else -1


@inner_kernel
def shows_pattern(state: EstimatorState, frame: FloatArray, cells: Cells) -> bool:
    """Return whether a solid tip's frame shows a contact: its pattern, by ``patch_level``.

    Much of a solid tip's pressure is spread over its base: a weak contact shows in all cells
    together long before it does in any neighbourhood. The pattern has a mean of 0 and squares that
    sum to 1, so that neither a shift of all cells' zeros nor noise that ends at 0 is a contact.
    """
    projection = 0.0
    for k in range(frame.shape[0]):
        projection += cells.pattern[k] * frame[k] if cells.height[k] >= 0.0 else 0.0
    level = state.options.patch_level * state.signal.noise
    return bool(projection > (_HYSTERESIS if state.estimate.warm else 1.0) * level)


@inner_kernel
def presses_outside(
    state: EstimatorState, frame: FloatArray, height: FloatArray, level: float
) -> bool:
    """Return whether cells of ``level`` or more, not one alone, lie two cells off the footprint.

    Three standard deviations of the blur are added to the two cells. ``level`` is in the frame's
    unit; the neighbours' weighted mean must reach a third of it.
    """
    grid = state.grid
    a = grid.radius
    cols = grid.cols
    face = state.around
    estimate = state.estimate
    margin = 2.0 * math.hypot(grid.pitch_x, grid.pitch_y) + 3.0 * state.options.blur
    if math.sqrt(max(estimate.d * (2.0 * a - estimate.d), 0.0)) + margin >= 0.99 * a:
        return False
    set_face(face, a, estimate.d, estimate.n_x, estimate.n_y)
    set_around(face, face, a, margin)
    for i in range(grid.rows):
        left, right = line_span(face, a, grid.y + (i + 0.5) * grid.pitch_y)
        first, last = steps(left, right, grid.x, grid.pitch_x, cols)
        start = i * cols
        at = next_above(frame, height, start, start + cols, level)
        while at < start + cols:
            # Σ w = 60 and √Σ w² = 13.4 over a whole neighbourhood.
            if not first <= at - start < last and (
                neighbourhood(frame, height, grid, at) > 1.5 * level
            ):
                return True
            at = next_above(frame, height, at + 1, start + cols, level)
    return False


_DEAD = 1e3  # m below: no face is ever there


@inner_kernel
def _is_outlier(state: EstimatorState, frame: FloatArray, height: FloatArray) -> bool:
    """Return whether the largest cell stands alone as no contact can.

    A contact about as wide as a cell could press ``signal.confined`` at most: a wider one never has
    a cell that stands at twice its neighbours.
    """
    rows = state.grid.rows
    cols = state.grid.cols
    i = state.signal.row
    j = state.signal.col
    total = 0.0
    number = 0
    for k, m in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
        if 0 <= k < rows and 0 <= m < cols and height[k * cols + m] >= 0.0:
            total += frame[k * cols + m]
            number += 1
    reading = frame[i * cols + j]
    noise = state.signal.noise
    return bool(
        number > 0
        and reading > 10.0 * noise + state.signal.confined
        and reading > 2.0 * max(total, 0.0) / max(number, 1) + 12.0 * noise
    )


@inner_kernel
def without_outliers(state: EstimatorState, frame: FloatArray, height: FloatArray) -> int:
    """Return the number of outliers; ``state.signal`` is what :func:`activity` finds without them.

    They are marked dead until :func:`restore_outliers`.
    """
    signal = state.signal
    cols = state.grid.cols
    rejected = 0
    activity(state, frame, height)
    while (
        signal.peak > 10.0 * signal.noise + signal.confined
        and signal.row >= 0
        and rejected < OUTLIERS_MAX
        and _is_outlier(state, frame, height)
    ):
        at = signal.row * cols + signal.col
        height[at] -= _DEAD
        signal.number -= 1
        state.outliers[rejected] = at
        rejected += 1
        activity(state, frame, height)
    return rejected


@inner_kernel
def restore_outliers(state: EstimatorState, rejected: int, height: FloatArray) -> None:
    """Make the outliers live again."""
    for k in range(rejected):
        height[state.outliers[k]] += _DEAD
        state.signal.number += 1
