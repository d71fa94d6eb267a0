"""Draw pressure maps in a terminal with half-block characters.

A half-block character shows two pixels, one above the other. A character cell is about twice as
tall as wide, so the pixels are square.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.style import Style
from rich.text import Span, Text

FloatArray = NDArray[np.float64]

LEVELS = 32  # number of colours; fewer colours give longer runs of one style and faster redraws
SHADES = " ·░▒▓█"  # used on terminals with too few colours

# Blue to yellow in equal steps of lightness, from dark to bright: the order is kept in greyscale
# and for colour-blind users.
_ANCHORS = (
    (24, 18, 56),
    (50, 46, 110),
    (44, 88, 140),
    (30, 128, 140),
    (44, 165, 118),
    (132, 198, 74),
    (250, 230, 70),
)


def colour_map() -> list[tuple[int, int, int]]:
    """Return the colours of the scale from zero to full, as (red, green, blue) in 0…255."""
    at = np.linspace(0.0, len(_ANCHORS) - 1.0, LEVELS)
    channels = [np.interp(at, range(len(_ANCHORS)), each) for each in zip(*_ANCHORS, strict=True)]
    return [(r, g, b) for r, g, b in np.rint(channels).T.astype(int).tolist()]


_COLOURS = [Color.from_rgb(*rgb) for rgb in colour_map()]


@lru_cache(maxsize=LEVELS * LEVELS)
def _pair_style(top: int, bottom: int) -> Style:
    return Style(color=_COLOURS[top], bgcolor=_COLOURS[bottom])


@lru_cache(maxsize=16)
def _overlaps(cells: int, pixels: int) -> FloatArray:
    """Return the overlap of each cell with each pixel of the same length; rows sum to 1."""
    edges = np.arange(pixels + 1) * (cells / pixels)
    low, high = edges[:-1, None], edges[1:, None]
    cell = np.arange(cells)[None, :]
    overlap = np.clip(np.minimum(high, cell + 1.0) - np.maximum(low, cell), 0.0, None)
    result: FloatArray = overlap / overlap.sum(axis=1, keepdims=True)
    return result


def resample(grid: FloatArray, height: int, width: int) -> FloatArray:
    """Resample ``grid`` [rows, cols] to [height, width] by area averaging, which keeps the mean."""
    rows, cols = grid.shape
    result: FloatArray = _overlaps(rows, height) @ grid @ _overlaps(cols, width).T
    return result


def fit(rows: int, cols: int, lines: int, columns: int, aspect: float = 1.0) -> tuple[int, int]:
    """Return the largest (lines, columns) that fit into the box and keep the shape of the cells.

    ``aspect`` is the height of a cell divided by its width.
    """
    slope = aspect * rows / cols
    width = min(columns, max(1, round(2 * lines / slope)))
    height = min(lines, max(1, round(width * slope / 2)))
    return height, width


def levels_of(pixels: FloatArray, full: float) -> NDArray[np.int64]:
    """Return colour indices: 0 for values up to zero, LEVELS − 1 from ``full`` on."""
    scaled = np.clip(np.nan_to_num(pixels / full), 0.0, 1.0)
    return np.rint(scaled * (LEVELS - 1)).astype(np.int64)


def picture(grid: FloatArray, full: float, lines: int, columns: int, coloured: bool) -> list[Text]:
    """Draw ``grid`` as ``lines`` of ``columns`` characters; y points up, so row 0 is at the bottom.

    ``full`` is the value shown in the brightest colour, or with the densest shade.
    """
    if not coloured:
        return [_shades(row) for row in levels_of(resample(grid, lines, columns), full)[::-1]]
    levels = levels_of(resample(grid, 2 * lines, columns), full)[::-1]
    return [_runs(levels[2 * k], levels[2 * k + 1]) for k in range(lines)]


def _runs(top: NDArray[np.int64], bottom: NDArray[np.int64]) -> Text:
    """Return one line in which neighbouring characters of equal colours share a span."""
    changes = np.flatnonzero(np.diff(top) | np.diff(bottom)) + 1
    starts, styles = [0, *changes.tolist()], (top * LEVELS + bottom).tolist()
    spans = [
        Span(start, end, _pair_style(*divmod(styles[start], LEVELS)))
        for start, end in zip(starts, [*starts[1:], len(styles)], strict=True)
    ]
    return Text("▀" * len(styles), spans=spans)


def _shades(levels: NDArray[np.int64]) -> Text:
    index = np.ceil(levels * ((len(SHADES) - 1) / (LEVELS - 1))).astype(int)
    return Text("".join(SHADES[i] for i in index))


def colour_bar(columns: int, coloured: bool) -> Text:
    """Draw the colour scale from zero to full in one line."""
    levels = levels_of(np.linspace(0.0, 1.0, columns), 1.0)
    return _runs(levels, levels) if coloured else _shades(levels)


def round_up(value: float) -> float:
    """Return the next round number at or above ``value`` > 0, as the end of a scale."""
    decade = 10.0 ** np.floor(np.log10(value))
    for step in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0):
        if value <= step * decade * (1.0 + 1e-9):
            return float(step * decade)
    return float(10.0 * decade)


class FullScale:
    """End of a colour scale that follows a signal's peak: up immediately, down with a delay."""

    def __init__(self, smallest: float, patience: float = 3.0) -> None:
        self._smallest = smallest
        # s for which the peak must stay below the next smaller scale before the scale shrinks
        self._patience = patience
        self._since: float | None = None
        self.value = smallest

    def follow(self, peak: float, now: float) -> float:
        """Update the scale for a signal's maximum ``peak`` at ``now`` [s]; return its end."""
        end = max(self._smallest, round_up(peak)) if peak > 0.0 else self._smallest
        if end >= self.value:
            self.value = end
            self._since = None
        elif self._since is None:
            self._since = now
        elif now - self._since > self._patience:
            self.value = end
            self._since = None
        return self.value
