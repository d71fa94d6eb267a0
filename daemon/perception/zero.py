"""Zero of a sensor in a grip: how far it has moved, by the cells beside the footprint.

A cell that nothing presses reads its zero. Under a tip of 20 mm some 60 % of a 58 mm grid is beside
the footprint, so the median of these cells follows the zero while the tip is pressed, and a second
contact on a few of them does not. Readings end at 0: a zero that falls below it is not seen here,
but by the joints' closing (`perception.witnesses`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_BESIDE = 2.0  # pitches from the footprint's rim, from which on a cell feels nothing of it
_FEWEST = 50  # cells: below, nothing is said


class ZeroWatch:
    """Follows one sensor's zero while a grip holds."""

    def __init__(self, grid: SensorGrid, radius: float, live: NDArray[np.bool_]) -> None:
        """``radius`` [m] of the tip; ``live`` [rows, cols]: cells that work."""
        (pitch_x, pitch_y), (centre_x, centre_y) = grid.pitches, grid.centre
        x = (np.arange(grid.cols) - 0.5 * (grid.cols - 1)) * pitch_x - centre_x
        y = (np.arange(grid.rows) - 0.5 * (grid.rows - 1)) * pitch_y - centre_y
        distance = np.hypot(*np.meshgrid(x, y)).ravel()
        cells = np.flatnonzero(live.ravel())
        self._cells = cells[np.argsort(distance[cells], kind="stable")]  # by their distance …
        self._distance = distance[self._cells]  # … from the tip's centre [m]
        self._radius = radius
        self._margin = _BESIDE * max(grid.pitches) + 3.0 * grid.blur
        self._reference = math.nan  # of the counts beside the footprint when the grip began to hold
        self.shift = 0  # counts that the zero has risen since the tare

    def forget(self) -> None:
        """The zero is learnt anew."""
        self.shift = 0
        self._reference = math.nan

    def follow(self, counts: NDArray[np.uint16], contact: ContactEstimate, holding: bool) -> None:
        """Take in a frame of raw ``counts`` and the last ``contact``; ``holding``: a grip rests."""
        if not holding:
            self._reference = math.nan
            return
        rim = self._radius - contact.d
        reach = math.sqrt(max(self._radius**2 - rim**2, 0.0)) + self._margin
        reach += max(rim, 0.0) * math.hypot(contact.tilt_x, contact.tilt_y)
        beside = self._cells[np.searchsorted(self._distance, reach) :]
        if beside.size < _FEWEST:
            return
        level = float(np.median(counts.ravel()[beside]))
        if math.isnan(self._reference):
            self._reference = level - self.shift
        self.shift = round(level - self._reference)

    def corrected(self, counts: NDArray[np.uint16], full: int) -> NDArray[np.uint16]:
        """Return the counts less what the zero has moved by; ``full`` ones stay."""
        if self.shift == 0:
            return counts
        moved = np.clip(counts.astype(np.int32) - self.shift, 0, full)
        return np.where(counts >= full, counts, moved).astype(np.uint16)
