"""Collect the loop's stage durations in histograms, and monitor the tick delays.

One call to a compiled function per tick updates the histograms. The daemon publishes the quantiles
of the histograms once per second. Each octave above 1 ns is divided into 32 bins. A quantile is
reported as the upper edge of its bin, so it is never too small and at most 3.2 % too large. The
maximum is exact.

Tick delays are measured in machine time and reported in occasional events. A fault text mentions a
tick delay that may have caused the fault. While a tick is late, real hardware is uncontrolled. A
simulated hand on its own clock waits (`daemon.clock.HandClock`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Event, TimeSpread, Timing
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

TIMES = ("wake", "compute", "bus", "publish")
QUANTILES = (0.5, 0.99, 0.999)

# Exponent of the first bin's lower edge, which is 2^-30 s = 0.93 ns. The first bin also counts
# shorter times.
_LOWEST_EXPONENT = -29
_OCTAVES = 36  # number of octaves, up to 64 s; the last bin also counts longer times
_BINS_PER_OCTAVE = 32
_BIN_COUNT = _OCTAVES * _BINS_PER_OCTAVE
_BIN_EDGES = np.ldexp(
    0.5 + 0.5 * np.arange(1, _BINS_PER_OCTAVE + 1) / _BINS_PER_OCTAVE,
    np.arange(_OCTAVES)[:, None] + _LOWEST_EXPONENT,
)
# Upper edges of the bins. The last bin is unbounded.
_UPPER_EDGES = np.append(_BIN_EDGES.ravel()[:-1], np.inf)

LATENESS_MIN = 0.05  # minimum delay that is reported [s]
# Minimum time between reports [s]. A report also requires that the total delay has doubled since
# the previous report.
REPORT_INTERVAL = 60.0
ATTRIBUTION_TIME = 0.25  # how long after a late tick a fault is attributed to this tick [s]
# Limits that a single late tick can violate.
_TIME_LIMITS = frozenset({"servos.bus", "servos.silent", "tactile.silent", "loop.overruns"})

Counts = NDArray[np.int64]
FloatArray = NDArray[np.float64]


@inner_kernel
def _bin(value: float) -> int:
    if not value > 0.0:
        return 0
    mantissa, exponent = math.frexp(value)  # 0.5 ≤ mantissa < 1
    place = (exponent - _LOWEST_EXPONENT) * _BINS_PER_OCTAVE + int(
        (mantissa - 0.5) * 2.0 * _BINS_PER_OCTAVE
    )
    return min(max(place, 0), _BIN_COUNT - 1)


@kernel
def record(counts: Counts, largest: FloatArray, times: tuple[float, float, float, float]) -> None:
    """Add one tick's times [s], in the order of `TIMES`, to the histograms.

    The arrays ``counts`` (int64 [times, bins]) and ``largest`` (float64 [times]) are updated in
    place.
    """
    for i in range(len(times)):
        counts[i, _bin(times[i])] += 1
        largest[i] = max(largest[i], times[i])


class Statistics:
    """Timing histograms of one loop. The loop passes both arrays to `record` once per tick."""

    def __init__(self) -> None:
        self.counts: Counts = np.zeros((len(TIMES), _BIN_COUNT), np.int64)
        self.largest: FloatArray = np.zeros(len(TIMES))
        record(self.counts, self.largest, (0.0, 0.0, 0.0, 0.0))  # compile now
        self.counts[:] = 0

    @property
    def ticks(self) -> int:
        """Number of counted ticks."""
        return int(self.counts[0].sum())

    def spreads(self) -> dict[str, TimeSpread]:
        """Return the quantiles and maximum of each time, or zeros before the first tick."""
        spreads = {}
        for name, until, largest in zip(
            TIMES, self.counts.cumsum(axis=1), self.largest, strict=True
        ):
            upper = _UPPER_EDGES[until.searchsorted(until[-1] * np.array(QUANTILES))]
            p50, p99, p999 = np.minimum(upper, largest).tolist()
            spreads[name] = TimeSpread(p50, p99, p999, float(largest))
        return spreads

    def table(self) -> list[str]:
        """Format the quantiles and maxima as a table in µs."""
        lines = [f"{'':8} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}  µs"]
        for name, spread in self.spreads().items():
            cells = " ".join(f"{1e6 * value:9.1f}" for value in spread)
            lines.append(f"{name:8} {cells}")
        return lines


class Lateness:
    """Monitor for the tick delays of one loop."""

    def __init__(self, settings: Settings, timing: Timing, waits: bool) -> None:
        """Create the monitor; it writes only the ``busy_s`` field of the loop's ``timing``.

        ``waits`` is True if the hand's clock pauses while the machine is late.
        """
        self._timing = timing
        self._period = 1.0 / settings.loop.rate
        self._waits = waits
        self._sum = 0.0  # total delay of the ticks, or total time that the hand has waited [s]
        self._reported = (0.0, -math.inf)  # total delay and clock time at the last report [s]
        self._busy_until = -math.inf

    def look(self, t: float, own_doing: bool) -> Event | None:
        """Evaluate the tick that began at ``t`` [s]; return an event to emit, or None.

        ``timing.tick_s`` must already be set for this tick. ``own_doing`` is True if a command
        executed on the previous tick may have delayed this tick.
        """
        timing = self._timing
        gap = 0.0 if own_doing else timing.tick_s - self._period
        if gap > LATENESS_MIN:
            timing.busy_s, self._busy_until = gap, t + ATTRIBUTION_TIME
        elif t > self._busy_until:
            timing.busy_s = 0.0
        if self._waits:  # `behind_s` does not yet include the delay of this tick.
            self._sum = timing.behind_s + max(timing.wake_late_s - self._period, 0.0)
        elif gap > LATENESS_MIN:
            self._sum += gap
        new = self._sum - self._reported[0]
        if new > max(LATENESS_MIN, self._reported[0]) and t - self._reported[1] > REPORT_INTERVAL:
            self._reported = (self._sum, t)
            return "warning", "late", self._text(new)
        return None

    def _text(self, new: float) -> str:
        did = (
            f"the simulated hand paused for {new:.2f} s"
            if self._waits
            else f"ticks were {new:.2f} s late"
        )
        return f"this machine is busy: {did}, {self._sum:.1f} s in total"

    def with_cause(self, name: str, text: str, at_work: float) -> str:
        """Return the fault text, prefixed with "this machine was busy" if a delay may be the cause.

        Parameters
        ----------
        name : name of the violated limit
        text : description of the fault
        at_work : duration of the current tick so far [s]
        """
        timing = self._timing
        if self._waits or name not in _TIME_LIMITS:
            return text
        if at_work > max(timing.busy_s, LATENESS_MIN):
            timing.busy_s = at_work
        if not timing.busy_s:
            return text
        return f"this machine was busy for {timing.busy_s * 1e3:.0f} ms: {text}"
