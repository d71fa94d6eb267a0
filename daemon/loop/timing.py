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

LATE = 0.05  # s of lateness that is reported
EVERY = 5.0  # s between two reports, of which each is of twice as much
RECENT = 0.25  # s after a late tick in which it may be a fault's cause
FIRST = 1.0  # s of ticks after which their steadiness is reported
_STEADY = 0.2  # share of the servos' watchdog time that a pause may take without a warning
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
        """The number of ticks that were counted."""
        return int(self.counts[0].sum())

    def spreads(self) -> dict[str, TimeSpread]:
        """Return what was counted, by the names in `TIMES`; all 0 before the first tick."""
        _quantiles(self.counts, self.largest, self._shares, self._out)
        rows = zip(TIMES, self._out.tolist(), self.largest.tolist(), strict=True)
        return {name: TimeSpread(row[0], row[1], row[2], largest) for name, row, largest in rows}

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
        self._watchdog = 0.0 if settings.simulated or waits else settings.servos.watchdog
        self._begin = math.nan
        self._worst = 0.0  # s by which a pause of the first second was longer than the period
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
        return self._steadiness(t, gap) if self._watchdog else None

    def _text(self, new: float) -> str:
        did = f"the hand waited {new:.2f} s" if self._waits else f"ticks came {new:.2f} s late"
        return f"this machine is busy: {did}, {self._sum:.1f} s in all"

    def _steadiness(self, t: float, gap: float) -> Event | None:
        """Once, the longest pause of the first second, against the servos' watchdog time."""
        if math.isnan(self._begin):
            self._begin = t
        self._worst = max(self._worst, gap)
        if t - self._begin < FIRST:
            return None
        budget, self._watchdog = self._watchdog, 0.0
        text = (
            "the longest pause between two ticks of the first second took "
            f"{(self._worst + self._period) * 1e3:.3g} ms; "
            f"the servos' watchdog stops them after {budget * 1e3:g} ms"
        )
        if self._worst <= _STEADY * budget:
            return "info", "realtime", text
        return (
            "warning",
            "realtime",
            f"{text}: this machine is too busy; realtime.priority and realtime.cpus keep others "
            "from the loop, softfinger doctor says what is missing",
        )

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
