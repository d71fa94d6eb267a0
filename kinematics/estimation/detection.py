"""Whether anything presses on a pressure grid, cheaply, and whether it can be one contact.

Kernels that look at readings and noise alone; no displacement or tilt comes from here.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer, address
from softfinger.kinematics.estimation.cell_centres import FIRST, LAST, NUMBER, next_above, totals
from softfinger.kinematics.sensing.footprint import (
    FloatArray,
    Geometry,
    IntArray,
    band_columns,
    extremes,
    line_span,
    plane,
)

_STRONG = 6.0  # noise: above it the largest cell is looked at first


@inner_kernel
def neighbourhood(frame: Pointer, height: Pointer, rows: int, cols: int, i: int, j: int) -> float:
    """How far the 5 × 5 cells round (i, j), without the middle one, stand above noise 1.

    Weights (1, 2, 2, 2, 1) both ways; the sum over its standard deviation. ``height`` is the plane
    of :mod:`estimation.cell_centres`: cells that are dead or out of reach don't count.
    """
    total = 0.0
    squares = 1e-30
    for k in range(max(i - 2, 0), min(i + 3, rows)):
        row_weight = 1.0 if abs(k - i) == 2 else 2.0
        for m in range(max(j - 2, 0), min(j + 3, cols)):
            weight = row_weight if abs(m - j) == 2 else 2.0 * row_weight
            counts = (height[k * cols + m] >= 0.0) & ((k != i) | (m != j))
            total += weight * frame[k * cols + m] if counts else 0.0
            squares += weight * weight if counts else 0.0
    return total / math.sqrt(squares)


@inner_kernel
def _walk(
    frame: Pointer,
    height: Pointer,
    rows: int,
    cols: int,
    first: int,
    last: int,
    level: float,
    patch: float,
    peak: float,
) -> tuple[bool, int]:
    """Whether a cell of ``level`` or more has neighbours above ``patch``; where the peak is."""
    contact = False
    place = -1
    at = next_above(frame, height, first, last, level)
    while at < last:
        place = at if frame[at] == peak else place
        contact = contact or (
            neighbourhood(frame, height, rows, cols, at // cols, at % cols) > patch
        )
        at = next_above(frame, height, at + 1, last, level)
    return contact, place


@inner_kernel
def activity(
    frame: FloatArray,
    middles: FloatArray,
    bounds: IntArray,
    noise: float,
    peak_level: float,
    patch_level: float,
) -> tuple[bool, int, int, float, float, float, bool]:
    """Cheap test: (contact, row and column of the largest cell, that cell, mean, Σ p², finite).

    ``noise`` is a cell's standard deviation in the frame's unit. A contact is a cell of
    ``peak_level`` · noise or more whose neighbours' weighted sum, itself left out, passes
    ``patch_level`` standard deviations: one hot cell alone is none. At levels 3 and 4.9 white noise
    passes for one in 788 · 1.35e-3 · 4.8e-7 = 5.1e-7 of the frames of 788 cells, a cell and its
    neighbours being independent; d = 0.2 mm under 0.2 % of the modulus as noise is seen in 99.98 %,
    measured over 150 000 frames, all azimuths, tilts up to 30° and places between the cells.

    ``middles`` and ``bounds`` are those of :func:`estimation.cell_centres.cell_middles`. The row
    and column are −1 where no cell reaches the level.
    """
    rows, cols = frame.shape
    readings = address(frame)
    height = address(middles)
    first = bounds[FIRST]
    last = bounds[LAST]
    total, energy, peak = totals(readings, height, first, last)
    finite = math.isfinite(total) and math.isfinite(peak)
    contact = False
    place = -1
    level = peak_level * noise
    patch = patch_level * noise
    if finite and peak >= level:
        if peak > _STRONG * noise:
            place = next_above(readings, height, first, last, peak)
            contact = (
                neighbourhood(readings, height, rows, cols, place // cols, place % cols) > patch
            )
        if not contact:
            contact, place = _walk(readings, height, rows, cols, first, last, level, patch, peak)
    row = place // cols if place >= 0 else -1
    col = place - row * cols if place >= 0 else -1
    return contact, row, col, peak, total / max(float(bounds[NUMBER]), 1.0), energy, finite


@inner_kernel
def presses_outside(
    frame: FloatArray,
    middles: FloatArray,
    geometry: Geometry,
    bounds: IntArray,
    level: float,
    d: float,
    n_x: float,
    n_y: float,
    blur: float,
) -> bool:
    """Whether a cell of ``level`` or more, and not it alone, lies two cells off the footprint.

    Three times the ``blur`` [m] are added to the two cells. ``level`` is in the frame's unit; the
    neighbours' weighted mean must reach a third of it.
    """
    a, x_first, y_first, pitch_x, pitch_y = geometry
    rows, cols = frame.shape
    readings = address(frame)
    height = address(middles)
    rho = math.sqrt(max(d * (2.0 * a - d), 0.0)) + 2.0 * math.hypot(pitch_x, pitch_y)
    rho += 3.0 * blur
    if rho >= 0.99 * a:
        return False
    u, v, w = plane(a, a - math.sqrt(a * a - rho * rho), n_x, n_y)
    ends = extremes(u, v, w, a)
    for i in range(bounds[FIRST] // cols, bounds[LAST] // cols):
        y0 = y_first + i * pitch_y
        below = line_span(u, v, w, a, y0)
        above = line_span(u, v, w, a, y0 + pitch_y)
        first, _, _, last = band_columns(
            u, v, w, a, ends, below, above, y0, y0 + pitch_y, x_first, pitch_x, cols
        )
        start = i * cols
        at = next_above(readings, height, start, start + cols, level)
        while at < start + cols:
            # Σ w = 60 and √Σ w² = 13.4 over a whole neighbourhood.
            if not first <= at - start < last and (
                neighbourhood(readings, height, rows, cols, i, at - start) > 1.5 * level
            ):
                return True
            at = next_above(readings, height, at + 1, start + cols, level)
    return False
