"""Zero and noise of a sensor, by the cells that no tip can press.

A cell that nothing presses reads its zero, and about it its noise. Under a tip of 20 mm some 60 %
of a 58 mm grid lies beyond the tip, so these cells show both whatever the tip does, and a second
contact on a few of them changes no median. Readings end at 0: a zero that falls below it is not
seen here, but by the joints' closing (`perception.hand_channels`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_BESIDE = 2.0  # pitches from the tip's rim, from which on a cell feels nothing of it
_FEWEST = 50  # cells: below, nothing is said
_AVERAGED = 8  # frames of which the noise is averaged
_CLIPPED = 0.25  # share of cells that read 0, from which on noise round 0 is cut in half …
_CLIPPED_VARIANCE = 0.5 - 0.5 / math.pi  # … which leaves so much of its variance


class UnpressedCells:
    """Follows one sensor's zero, and its noise."""

    def __init__(self, grid: SensorGrid, radius: float, live: NDArray[np.bool_]) -> None:
        """``radius`` [m] of the tip; ``live`` [rows, cols]: cells that work."""
        (pitch_x, pitch_y), (centre_x, centre_y) = grid.pitches, grid.centre
        x = (np.arange(grid.cols) - 0.5 * (grid.cols - 1)) * pitch_x - centre_x
        y = (np.arange(grid.rows) - 0.5 * (grid.rows - 1)) * pitch_y - centre_y
        distance = np.hypot(*np.meshgrid(x, y))
        reach = radius + _BESIDE * max(grid.pitches) + 3.0 * grid.blur
        cells = np.flatnonzero(live & (distance > reach))
        self._cells = cells if cells.size >= _FEWEST else cells[:0]
        self._live = np.flatnonzero(live)
        self._before: NDArray[np.float64] | None = None  # what these read
        self._squares: NDArray[np.float64] | None = None  # of their changes, averaged
        self._zeros = 0.0  # share of them that read 0
        self._reference: float | None = None  # median of these cells at the tare
        self._variance: float | None = None
        self.shift = 0  # counts that the zero has risen since the tare

    @property
    def noise(self) -> float:
        """Standard deviation of a cell [counts]; 0 where nothing shows it."""
        return 0.0 if self._variance is None else math.sqrt(self._variance)

    @property
    def scatter(self) -> float:
        """Noise by what all cells do from frame to frame [counts], where none is out of reach.

        Most of them rest, except while a tip moves. 0 where nothing shows it.
        """
        if self._squares is None:
            return self.noise
        variance = 0.5 * float(np.median(self._squares))
        return math.sqrt(variance / (_CLIPPED_VARIANCE if self._zeros > _CLIPPED else 1.0))

    def forget_zero(self) -> None:
        """The zero is learnt anew."""
        self.shift = 0
        self._reference = None

    def follow(self, counts: NDArray[np.uint16]) -> None:
        """Take in a frame of raw ``counts``."""
        if not self._cells.size:
            self._compare(counts.ravel()[self._live].astype(np.float64))
            return
        read = counts.ravel()[self._cells].astype(np.float64)
        level = float(np.median(read))
        if self._reference is None:
            self._reference = level
        self.shift = round(level - self._reference)
        # What is above the median alone: readings may end below it. A cell that something presses
        # counts as if it were three deviations off; the counts' own rounding is known to others.
        above = np.maximum(read - level, 0.0)
        most = 3.0 * max(self.noise, 1.0) if self._variance is not None else math.inf
        square = 2.0 * float(np.square(np.minimum(above, most)).mean()) - 1.0 / 12.0
        square = max(square, 0.0)
        before = square if self._variance is None else self._variance
        self._variance = before + (square - before) / _AVERAGED

    def _compare(self, read: NDArray[np.float64]) -> None:
        before, self._before = self._before, read
        if before is None:
            return
        squares = np.square(read - before)
        last = squares if self._squares is None else self._squares
        self._squares = last + (squares - last) / _AVERAGED
        self._zeros = 1.0 - np.count_nonzero(read) / read.size

    def corrected(self, counts: NDArray[np.uint16], full: int) -> NDArray[np.uint16]:
        """Return the counts less what the zero has moved by; ``full`` ones stay."""
        if self.shift == 0:
            return counts
        moved = np.clip(counts.astype(np.int32) - self.shift, 0, full)
        return np.where(counts >= full, counts, moved).astype(np.uint16)
