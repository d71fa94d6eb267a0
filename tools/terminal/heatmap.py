"""Pressure maps in a terminal: colour scale, resampling to fit, rows of half-block characters.

A half-block character carries two pixels, one above the other, and a character cell is about twice
as tall as wide, so the pixels come out square.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.style import Style
from rich.text import Span, Text

FloatArray = NDArray[np.float64]

LEVELS = 32  # colours; fewer make longer runs of one style and lighter redraws
SHADES = " ·░▒▓█"  # for terminals with too few colours

# From dark to bright in even steps of lightness, blue to yellow: the same order in grey and for
# colour-blind people.
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
    """Return the scale's colours from zero to full, as (red, green, blue) of 0…255."""
    at = np.linspace(0.0, len(_ANCHORS) - 1.0, LEVELS)
    channels = [np.interp(at, range(len(_ANCHORS)), each) for each in zip(*_ANCHORS, strict=True)]
    return [(r, g, b) for r, g, b in np.rint(channels).T.astype(int).tolist()]


_COLOURS = [Color.from_rgb(*rgb) for rgb in colour_map()]


@lru_cache(maxsize=LEVELS * LEVELS)
def _pair_style(top: int, bottom: int) -> Style:
    return Style(color=_COLOURS[top], bgcolor=_COLOURS[bottom])


@lru_cache(maxsize=16)
def _overlaps(cells: int, pixels: int) -> FloatArray:
    """Share of each of ``cells`` in each of ``pixels`` on the same length; rows sum to 1."""
    edges = np.arange(pixels + 1) * (cells / pixels)
    low, high = edges[:-1, None], edges[1:, None]
    cell = np.arange(cells)[None, :]
    overlap = np.clip(np.minimum(high, cell + 1.0) - np.maximum(low, cell), 0.0, None)
    result: FloatArray = overlap / overlap.sum(axis=1, keepdims=True)
    return result


def resample(grid: FloatArray, height: int, width: int) -> FloatArray:
    """Return area average of ``grid`` [rows, cols] on [height, width] pixels; keeps the mean."""
    rows, cols = grid.shape
    result: FloatArray = _overlaps(rows, height) @ grid @ _overlaps(cols, width).T
    return result


def fit(rows: int, cols: int, lines: int, columns: int, aspect: float = 1.0) -> tuple[int, int]:
    """Return the largest (lines, columns) of characters in the box that keeps the cells' shape.

    ``aspect``: a cell's height over its width.
    """
    slope = aspect * rows / cols
    width = min(columns, max(1, round(2 * lines / slope)))
    height = min(lines, max(1, round(width * slope / 2)))
    return height, width


def levels_of(pixels: FloatArray, full: float) -> NDArray[np.int64]:
    """Return index into the colour map, 0 for nothing and below, LEVELS − 1 from ``full`` on."""
    scaled = np.clip(np.nan_to_num(pixels / full), 0.0, 1.0)
    return np.rint(scaled * (LEVELS - 1)).astype(np.int64)


def picture(grid: FloatArray, full: float, lines: int, columns: int, coloured: bool) -> list[Text]:
    """Return ``grid`` as ``lines`` of ``columns`` characters, row 0 lowest as y points up.

    ``full`` is the value that gets the brightest colour, or the densest shade.
    """
    if not coloured:
        return [_shades(row) for row in levels_of(resample(grid, lines, columns), full)[::-1]]
    levels = levels_of(resample(grid, 2 * lines, columns), full)[::-1]
    return [_runs(levels[2 * k], levels[2 * k + 1]) for k in range(lines)]


def _runs(top: NDArray[np.int64], bottom: NDArray[np.int64]) -> Text:
    """One line, neighbours of the same two colours in one span."""
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
    """Return the scale from nothing to full, in one line."""
    levels = levels_of(np.linspace(0.0, 1.0, columns), 1.0)
    return _runs(levels, levels) if coloured else _shades(levels)


def round_up(value: float) -> float:
    """Return the next round number at or above ``value`` > 0, for the end of a scale."""
    decade = 10.0 ** np.floor(np.log10(value))
    for step in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0):
        if value <= step * decade * (1.0 + 1e-9):
            return float(step * decade)
    return float(10.0 * decade)


class FullScale:
    """End of a scale that follows a signal's peak: up at once, down only after a while."""

    def __init__(self, smallest: float, patience: float = 3.0) -> None:
        self._smallest = smallest
        self._patience = patience  # s below the next smaller scale before it shrinks
        self._since: float | None = None
        self.value = smallest

    def follow(self, peak: float, now: float) -> float:
        """Return the scale's end for a signal that peaks at ``peak`` at time ``now`` [s]."""
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
