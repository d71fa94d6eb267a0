"""The loop's own times: histograms, read out once a second; and how late its ticks are.

Histograms take one kernel call a tick. Each octave from 1 ns up is cut into 32 bins, so that a
quantile, given as its bin's upper edge, is never understated and at most 3.2 % too great; the
largest value is kept as it is.

Lateness is reported by an event now and then, and as a fault's cause. Its times are the machine's.
Meanwhile a hand on real time was left alone; a simulated one on its own time has waited
(`daemon.clock.HandClock`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import TimeSpread, Timing
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

TIMES = ("wake", "compute", "bus", "publish")
QUANTILES = (0.5, 0.99, 0.999)

_LOWEST = -29  # 2^-30 s = 0.93 ns is the first bin's lower edge; shorter times fall into it, too
_OCTAVES = 36  # up to 64 s; longer times fall into the last bin
_PARTS = 32  # bins an octave
_BINS = _OCTAVES * _PARTS
_EDGES = np.ldexp(
    0.5 + 0.5 * np.arange(1, _PARTS + 1) / _PARTS, np.arange(_OCTAVES)[:, None] + _LOWEST
)
_UPPER = np.append(_EDGES.ravel()[:-1], np.inf)  # edge of each bin; the last one has none

LATE = 0.05  # s of lateness that is reported
EVERY = 60.0  # s between two reports, of which each is of twice as much
RECENT = 0.25  # s after a late tick in which it may be a fault's cause
# Limits that a late tick alone can break.
_BY_TIME = frozenset({"servos.bus", "servos.silent", "tactile.silent", "loop.overruns"})

Event = tuple[str, str, str]
Counts = NDArray[np.int64]
FloatArray = NDArray[np.float64]


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


class Statistics:
    """The histograms of one loop. `record` is called with its two arrays once a tick."""

    def __init__(self) -> None:
        self.counts: Counts = np.zeros((len(TIMES), _BINS), np.int64)
        self.largest: FloatArray = np.zeros(len(TIMES))
        record(self.counts, self.largest, (0.0, 0.0, 0.0, 0.0))  # compiles; no tick does
        self.counts[:] = 0

    @property
    def ticks(self) -> int:
        """The number of ticks that were counted."""
        return int(self.counts[0].sum())

    def spreads(self) -> dict[str, TimeSpread]:
        """Return what was counted, by the names in `TIMES`; all 0 before the first tick."""
        spreads = {}
        for name, until, largest in zip(
            TIMES, self.counts.cumsum(axis=1), self.largest, strict=True
        ):
            upper = _UPPER[until.searchsorted(until[-1] * np.array(QUANTILES))]
            p50, p99, p999 = np.minimum(upper, largest).tolist()
            spreads[name] = TimeSpread(p50, p99, p999, float(largest))
        return spreads

    def table(self) -> list[str]:
        """Return the same for people, in µs."""
        lines = [f"{'':8} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}  µs"]
        for name, spread in self.spreads().items():
            cells = " ".join(f"{1e6 * value:9.1f}" for value in spread)
            lines.append(f"{name:8} {cells}")
        return lines


class Lateness:
    """Follows one loop's ticks."""

    def __init__(self, settings: Settings, timing: Timing, waits: bool) -> None:
        """``timing`` is the loop's own; what is written there is ``busy_s`` alone.

        ``waits``: the hand's time stands still while the machine is late.
        """
        self._timing = timing
        self._period = 1.0 / settings.loop.rate
        self._waits = waits
        self._sum = 0.0  # s that ticks came late in all, or that the hand has waited
        self._reported = (0.0, -math.inf)  # that sum, and when
        self._busy_until = -math.inf

    def look(self, t: float, own_doing: bool) -> Event | None:
        """Take in the tick that began at ``t`` [s] and whose ``timing`` is up to its start.

        ``own_doing``: the last one was late because of a command. The event to emit, if any.
        """
        timing = self._timing
        gap = 0.0 if own_doing else timing.tick_s - self._period
        if gap > LATE:
            timing.busy_s, self._busy_until = gap, t + RECENT
        elif t > self._busy_until:
            timing.busy_s = 0.0
        if self._waits:  # and will have waited for this tick's lateness when the next is due
            self._sum = timing.behind_s + max(timing.wake_late_s - self._period, 0.0)
        elif gap > LATE:
            self._sum += gap
        new = self._sum - self._reported[0]
        if new > max(LATE, self._reported[0]) and t - self._reported[1] > EVERY:
            self._reported = (self._sum, t)
            return "warning", "late", self._text(new)
        return None

    def _text(self, new: float) -> str:
        did = f"the hand waited {new:.2f} s" if self._waits else f"ticks came {new:.2f} s late"
        return f"this machine is busy: {did}, {self._sum:.1f} s in all"

    def with_cause(self, name: str, text: str, at_work: float) -> str:
        """Return a finding's text, after "this machine was busy" where it was so a moment ago.

        ``name`` is the broken limit's; ``at_work`` [s] how long the present tick has taken so far.
        """
        timing = self._timing
        if self._waits or name not in _BY_TIME:
            return text
        if at_work > max(timing.busy_s, LATE):
            timing.busy_s = at_work
        if not timing.busy_s:
            return text
        return f"this machine was busy for {timing.busy_s * 1e3:.0f} ms: {text}"
