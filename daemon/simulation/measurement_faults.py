"""Measurements of the simulated hand that are wrong, at once or more and more: what a sensor reads.

The hand itself is as it was: pressure on a tip, a motor's current and how it follows its goal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LONGEST_REPLAY = 3.0  # s


class MeasurementFault(NamedTuple):
    """A kind: its value where nothing is wrong, and the bounds of its value."""

    honest: float
    low: float
    high: float


MEASUREMENT_FAULTS = {
    "gain": MeasurementFault(1.0, 0.0, 100.0),  # each cell reads so many times its pressure
    "shift-x": MeasurementFault(0.0, -255.0, 255.0),  # cells, towards higher columns; zeros follow
    "shift-y": MeasurementFault(0.0, -255.0, 255.0),  # and towards higher rows
    "mirror": MeasurementFault(0.0, 0.0, 1.0),  # 1: the columns are in reverse order
    "drift": MeasurementFault(0.0, -1.0, 1.0),  # share of the largest count that each cell gains
    "replay": MeasurementFault(0.0, 0.0, LONGEST_REPLAY),  # s of frames that come again and again
    "current": MeasurementFault(1.0, -100.0, 100.0),  # the servo reads so many times its current
}
SUDDEN = ("mirror", "replay")  # have nothing between off and on


@dataclass(slots=True)
class _Ramp:
    """A value that changes evenly from one to another."""

    before: float
    after: float
    begin: float  # s
    over: float  # s

    def __call__(self, t: float) -> float:
        if t < self.begin:
            return self.before
        if t >= self.begin + self.over:
            return self.after
        return self.before + (self.after - self.before) * (t - self.begin) / self.over


class MeasurementFaults:
    """Faults of one finger's tactile sensor and of its servo's present current."""

    def __init__(self) -> None:
        self._ramps: dict[str, _Ramp] = {}

    def begin(self, kind: str, value: float, t: float, over: float = 0.0) -> None:
        """Let a kind of MEASUREMENT_FAULTS go to ``value`` from ``t`` on, evenly in ``over`` [s].

        It starts from what it is at ``t``, and takes the place of a change that has not ended then.
        Raises KeyError for another kind.
        """
        self._ramps[kind] = _Ramp(self(kind, t), value, t, over)

    def clear(self) -> None:
        """End all of them at once."""
        self._ramps.clear()

    def __call__(self, kind: str, t: float) -> float:
        """The value of a kind at time ``t`` [s]."""
        ramp = self._ramps.get(kind)
        return MEASUREMENT_FAULTS[kind].honest if ramp is None else ramp(t)

    def apply(self, signal: FloatArray, full_count: int, t: float) -> None:
        """Change a sensor's counts ``signal`` [rows, cols] in place, as it reads them at ``t`` [s].

        Between whole cells a shifted image is interpolated.
        """
        if not self._ramps:
            return
        if self("mirror", t) > 0.0:
            signal[:] = signal[:, ::-1].copy()
        rows, cols = (
            _shift(count, self(kind, t))
            for count, kind in zip(signal.shape, ("shift-y", "shift-x"), strict=True)
        )
        signal[:] = self("gain", t) * (rows @ signal @ cols.T) + self("drift", t) * full_count


def _shift(count: int, cells: float) -> FloatArray:
    """Return the matrix [count, count] that shifts ``count`` values by so many cells, linearly."""
    places = np.arange(count)
    weights: FloatArray = np.maximum(1.0 - np.abs(places[:, None] - places - cells), 0.0)
    return weights
