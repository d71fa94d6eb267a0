"""How late this machine is with the loop's ticks: an event now and then, and a fault's cause.

All times are the machine's own. Meanwhile a hand on real time was left alone; a simulated one on
its own time has waited (`daemon.clock.HandClock`).
"""

from __future__ import annotations

import math

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Timing

LATE = 0.05  # s of lateness that is reported
EVERY = 5.0  # s between two reports
RECENT = 0.25  # s after a late tick in which it may be a fault's cause
FIRST = 1.0  # s of ticks after which their steadiness is reported
_STEADY = 0.2  # share of the servos' watchdog time that a pause may take without a warning
# Limits that a late tick alone can break.
_BY_TIME = frozenset({"servos.bus", "servos.silent", "tactile.silent", "loop.overruns"})

Event = tuple[str, str, str]


class Lateness:
    """Follows one loop's ticks."""

    def __init__(self, settings: Settings, timing: Timing) -> None:
        """``timing`` is the loop's own; what is written there is ``busy_s`` alone."""
        self._timing = timing
        self._period = 1.0 / settings.loop.rate
        self._waits = settings.simulated and settings.loop.clock != "real"
        self._watchdog = 0.0 if settings.simulated else settings.servos.watchdog
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
        if new > LATE and t - self._reported[1] > EVERY:
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
        """A finding's text, after "this machine was busy" where it was so a moment ago.

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
