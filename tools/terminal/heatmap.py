"""Draw pressure maps in a terminal with half-block characters.

Each half-block character shows two pixels, one above the other. The pixels are square, because a
character cell is about twice as tall as it is wide.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.style import Style
from rich.text import Span, Text

FloatArray = NDArray[np.float64]

LEVELS = 32  # number of colours; redraws are faster with fewer colours
SHADES = " ·░▒▓█"  # shades for terminals with too few colours
_SHRINK_TIME = 3.0  # time for which a smaller scale must suffice before the scale shrinks [s]

# Lightness increases in equal steps from dark blue to bright yellow. The order of the colours is
# therefore also visible in greyscale and to colour-blind users.
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
    """Return the colours from zero to full scale, as (red, green, blue) from 0 to 255."""
    at = np.linspace(0.0, len(_ANCHORS) - 1.0, LEVELS)
    channels = [np.interp(at, range(len(_ANCHORS)), each) for each in zip(*_ANCHORS, strict=True)]
    return [(r, g, b) for r, g, b in np.rint(channels).T.astype(int).tolist()]


_COLOURS = [Color.from_rgb(*rgb) for rgb in colour_map()]


@lru_cache(maxsize=LEVELS * LEVELS)
def _pair_style(top: int, bottom: int) -> Style:
    return Style(color=_COLOURS[top], bgcolor=_COLOURS[bottom])


@lru_cache(maxsize=16)
def _overlaps(cells: int, pixels: int) -> FloatArray:
    """Return the fraction of each pixel that each cell covers along one axis; rows sum to 1."""
    edges = np.arange(pixels + 1) * (cells / pixels)
    low, high = edges[:-1, None], edges[1:, None]
    cell = np.arange(cells)[None, :]
    overlap = np.clip(np.minimum(high, cell + 1.0) - np.maximum(low, cell), 0.0, None)
    result: FloatArray = overlap / overlap.sum(axis=1, keepdims=True)
    return result


def resample(grid: FloatArray, height: int, width: int) -> FloatArray:
    """Resample ``grid`` [rows, cols] to [height, width] by averaging areas, preserving the mean."""
    rows, cols = grid.shape
    result: FloatArray = _overlaps(rows, height) @ grid @ _overlaps(cols, width).T
    return result


def fit(rows: int, cols: int, lines: int, columns: int, aspect: float = 1.0) -> tuple[int, int]:
    """Return the largest size (lines, columns) that fits into the box and preserves the cell shape.

    ``aspect`` is a cell's height divided by its width.
    """
    slope = aspect * rows / cols
    width = min(columns, max(1, round(2 * lines / slope)))
    height = min(lines, max(1, round(width * slope / 2)))
    return height, width


def levels_of(pixels: FloatArray, full: float) -> NDArray[np.int64]:
    """Convert values to colour indices: 0 for values ≤ 0, LEVELS − 1 for values ≥ ``full``."""
    scaled = np.clip(np.nan_to_num(pixels / full), 0.0, 1.0)
    return np.rint(scaled * (LEVELS - 1)).astype(np.int64)


def picture(grid: FloatArray, full: float, lines: int, columns: int, coloured: bool) -> list[Text]:
    """Draw ``grid`` as ``lines`` lines of ``columns`` characters, with row 0 at the bottom.

    ``full`` is the value shown in the brightest colour or with the densest shade.
    """
    if not coloured:
        return [_shades(row) for row in levels_of(resample(grid, lines, columns), full)[::-1]]
    levels = levels_of(resample(grid, 2 * lines, columns), full)[::-1]
    return [_runs(levels[2 * k], levels[2 * k + 1]) for k in range(lines)]


def _runs(top: NDArray[np.int64], bottom: NDArray[np.int64]) -> Text:
    """Return one line in which adjacent characters with equal colours share a span."""
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
    """Draw the colour scale from zero to full scale in one line."""
    levels = levels_of(np.linspace(0.0, 1.0, columns), 1.0)
    return _runs(levels, levels) if coloured else _shades(levels)


def round_up(value: float) -> float:
    """Round ``value`` > 0 up to the next round number, for the end of a scale."""
    decade = 10.0 ** np.floor(np.log10(value))
    for step in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0):
        if value <= step * decade * (1.0 + 1e-9):
            return float(step * decade)
    return float(10.0 * decade)


class FullScale:
    """Full-scale value that rises immediately with a signal's peak, and falls after a delay."""

    def __init__(self, smallest: float) -> None:
        self._smallest = smallest
        self._since: float | None = None
        self.value = smallest

    def follow(self, peak: float, now: float) -> float:
        """Update the scale with the signal's ``peak`` at time ``now`` [s], and return the scale."""
        end = max(self._smallest, round_up(peak)) if peak > 0.0 else self._smallest
        if end >= self.value or (self._since is not None and now - self._since > _SHRINK_TIME):
            self.value, self._since = end, None
        elif self._since is None:
            self._since = now
        return self.value
