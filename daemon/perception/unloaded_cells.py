"""Use the cells outside the tip to measure the zero shift and the noise of a sensor.

An unloaded cell reads its zero offset plus noise. With a tip radius of 20 mm, about 60 % of a 58 mm
wide grid lies outside the tip. The outer cells show the zero offset and the noise even while the
tip is in contact. A second contact that loads only a few outer cells does not change the median
reading. Readings are clipped at 0, so unloaded cells cannot show a negative zero offset. If the
offset falls during a grip, the hand filter estimates the offset as `D_BIAS`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_RIM_DISTANCE = 2.0  # minimum distance of an unloaded cell from the tip rim, in cell pitches
_CELL_COUNT_MIN = 50  # minimum number of cells for estimating the zero shift and the noise
_AVERAGED_FRAME_COUNT = 8  # time constant of the noise average, in calls to `update`
_CLIPPED_FRACTION = 0.25  # fraction of cells that read 0 above which the noise counts as clipped
_CLIPPED_VARIANCE = 0.5 - 0.5 / math.pi  # fraction of the variance that remains after clipping at 0


class UnloadedCells:
    """Estimator for one sensor's zero shift and noise."""

    def __init__(self, grid: SensorGrid, radius: float, live: NDArray[np.bool_]) -> None:
        """Create an estimator for a tip of ``radius`` [m]; ``live`` is True for working cells."""
        (pitch_x, pitch_y), (centre_x, centre_y) = grid.pitches, grid.centre
        x = (np.arange(grid.cols) - 0.5 * (grid.cols - 1)) * pitch_x - centre_x
        y = (np.arange(grid.rows) - 0.5 * (grid.rows - 1)) * pitch_y - centre_y
        distance = np.hypot(*np.meshgrid(x, y))
        reach = radius + _RIM_DISTANCE * max(grid.pitches) + 3.0 * grid.blur
        cells = np.flatnonzero(live & (distance > reach))
        self._cells = cells if cells.size >= _CELL_COUNT_MIN else cells[:0]
        self._live = np.flatnonzero(live)
        self._last_readings: NDArray[np.float64] | None = None  # last readings of the live cells
        self._squared_changes: NDArray[np.float64] | None = None  # running average
        self._zero_fraction = 0.0  # fraction of the live cells that read 0
        self._reference: float | None = None  # median of the unloaded cells at the last tare
        self._variance: float | None = None
        self.zero_shift = 0  # change in zero offset since the tare [counts]

    @property
    def noise(self) -> float:
        """Standard deviation of an unloaded cell's reading [counts]; 0 if unknown."""
        return 0.0 if self._variance is None else math.sqrt(self._variance)

    @property
    def scatter(self) -> float:
        """Cell noise [counts]; 0 if unknown.

        If no cells lie outside the tip, the noise is computed from the changes between frames. Most
        changes are noise, because the loads change only while a tip moves.
        """
        if self._squared_changes is None:
            return self.noise
        variance = 0.5 * float(np.median(self._squared_changes))
        return math.sqrt(
            variance / (_CLIPPED_VARIANCE if self._zero_fraction > _CLIPPED_FRACTION else 1.0)
        )

    def reset_zero(self) -> None:
        """Reset the zero shift and the noise; the next frame sets a new reference."""
        self.zero_shift = 0
        self._reference = self._variance = None

    def update(self, counts: NDArray[np.uint16], zero: NDArray[Any] | None = None) -> None:
        """Update the estimates with a frame of raw ``counts``; ``zero`` contains the zero offsets.

        The offsets of the cells differ, so without ``zero`` their spread would count as noise.
        """
        if not self._cells.size:
            self._update_changes(counts.ravel()[self._live].astype(np.float64))
            return
        read = counts.ravel()[self._cells].astype(np.float64)
        if zero is not None:
            read -= zero.ravel()[self._cells]
        level = float(np.median(read))
        if self._reference is None:
            self._reference = level
        self.zero_shift = round(level - self._reference)
        # Readings below the median may be clipped, so use only readings above the median. Some
        # cells may be loaded, so limit each deviation to three standard deviations. The error
        # budget adds the quantisation error separately, so subtract the quantisation variance
        # (1/12).
        above = np.maximum(read - level, 0.0)
        deviation_max = 3.0 * max(self.noise, 1.0) if self._variance is not None else math.inf
        square = 2.0 * float(np.square(np.minimum(above, deviation_max)).mean()) - 1.0 / 12.0
        square = max(square, 0.0)
        previous = square if self._variance is None else self._variance
        self._variance = previous + (square - previous) / _AVERAGED_FRAME_COUNT

    def _update_changes(self, read: NDArray[np.float64]) -> None:
        previous, self._last_readings = self._last_readings, read
        if previous is None:
            return
        squares = np.square(read - previous)
        last = squares if self._squared_changes is None else self._squared_changes
        self._squared_changes = last + (squares - last) / _AVERAGED_FRAME_COUNT
        self._zero_fraction = 1.0 - np.count_nonzero(read) / read.size

    def corrected(self, counts: NDArray[np.uint16], full: int) -> NDArray[np.uint16]:
        """Return the counts minus the zero shift. Saturated counts (``full``) are not changed."""
        if self.zero_shift == 0:
            return counts
        moved = np.clip(counts.astype(np.int32) - self.zero_shift, 0, full)
        return np.where(counts >= full, counts, moved).astype(np.uint16)
