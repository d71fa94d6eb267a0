"""Histograms of the loop's own times: one kernel call a tick, read out once a second.

Holds bins, counting and quantiles, and nothing that knows the loop or the wire. Each octave from
1 ns up is cut into 32 bins, so that a quantile, given as its bin's upper edge, is never understated
and at most 3.2 % too great; the largest value is kept as it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

TIMES = ("wake", "compute", "bus", "publish")
QUANTILES = (0.5, 0.99, 0.999)

_LOWEST = -29  # 2^-30 s = 0.93 ns is the first bin's lower edge; shorter times fall into it, too
_OCTAVES = 36  # up to 64 s; longer times fall into the last bin
_PARTS = 32  # bins an octave
_BINS = _OCTAVES * _PARTS

Counts = NDArray[np.int64]
FloatArray = NDArray[np.float64]


class TimeSpread(NamedTuple):
    """One time's median, tail and largest value since the start [s]."""

    p50: float
    p99: float
    p999: float
    max: float


@inner_kernel
def _bin(value: float) -> int:
    if not value > 0.0:
        return 0
    mantissa, exponent = math.frexp(value)  # 0.5 ≤ mantissa < 1
    place = (exponent - _LOWEST) * _PARTS + int((mantissa - 0.5) * 2.0 * _PARTS)
    return min(max(place, 0), _BINS - 1)


@kernel
def record(counts: Counts, largest: FloatArray, times: tuple[float, float, float, float]) -> None:
    """Count one tick's times [s], in the order of `TIMES`.

    ``counts`` int64 [times, bins] and ``largest`` float64 [times] change in place.
    """
    for i in range(len(times)):
        counts[i, _bin(times[i])] += 1
        largest[i] = max(largest[i], times[i])


@kernel
def _quantiles(counts: Counts, largest: FloatArray, shares: FloatArray, out: FloatArray) -> None:
    """Upper edge of each share's bin, [4, shares]; no more than the largest value."""
    for i in range(counts.shape[0]):
        total = 0
        for k in range(counts.shape[1]):
            total += counts[i, k]
        seen = 0
        j = 0
        for k in range(counts.shape[1]):
            seen += counts[i, k]
            while j < shares.shape[0] and total > 0 and seen >= shares[j] * total:
                octave = k // _PARTS
                upper = math.ldexp(0.5 + 0.5 * (k - octave * _PARTS + 1) / _PARTS, octave + _LOWEST)
                # The last bin has no upper edge.
                out[i, j] = largest[i] if k == counts.shape[1] - 1 else min(upper, largest[i])
                j += 1
        while j < shares.shape[0]:
            out[i, j] = 0.0
            j += 1


class Statistics:
    """The histograms of one loop. `record` is called with its two arrays once a tick."""

    def __init__(self) -> None:
        self.counts: Counts = np.zeros((len(TIMES), _BINS), np.int64)
        self.largest: FloatArray = np.zeros(len(TIMES))
        self._shares = np.array(QUANTILES)
        self._out = np.zeros((len(TIMES), len(QUANTILES)))
        record(self.counts, self.largest, (0.0, 0.0, 0.0, 0.0))  # compiles; no tick does
        self.spreads()
        self.reset()

    def reset(self) -> None:
        """Forget all that was counted."""
        self.counts[:] = 0
        self.largest[:] = 0.0

    @property
    def ticks(self) -> int:
        """How many were counted."""
        return int(self.counts[0].sum())

    def spreads(self) -> dict[str, TimeSpread]:
        """What was counted, by the names in `TIMES`; all 0 before the first tick."""
        _quantiles(self.counts, self.largest, self._shares, self._out)
        rows = zip(TIMES, self._out.tolist(), self.largest.tolist(), strict=True)
        return {name: TimeSpread(row[0], row[1], row[2], largest) for name, row, largest in rows}

    def table(self) -> list[str]:
        """The same for people, in µs."""
        lines = [f"{'':8} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}  µs"]
        for name, spread in self.spreads().items():
            cells = " ".join(f"{1e6 * value:9.1f}" for value in spread)
            lines.append(f"{name:8} {cells}")
        return lines
