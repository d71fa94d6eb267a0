"""Real and virtual time. The loop asks its clock for the time and never the system itself."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time for the pipeline, in seconds."""

    def now(self) -> float:
        """Monotonic time [s]."""

    def wall(self) -> float:
        """Unix time [s] that belongs to now."""

    def sleep_until(self, t: float) -> None:
        """Return at monotonic time ``t``, at once if that has passed."""


class RealClock:
    """The machine's monotonic clock.

    The last ``spin`` s before the end of a sleep are waited awake: the system's own wake-up takes
    tens of microseconds, which the spin covers. That time is lost to others on the processor.
    """

    now = staticmethod(time.monotonic)
    wall = staticmethod(time.time)

    def __init__(self, spin: float = 0.0) -> None:
        self._spin = spin

    def sleep_until(self, t: float) -> None:
        """Sleep; a signal handler may run meanwhile, and the sleep goes on after it."""
        now = time.monotonic
        delay = t - self._spin - now()
        if delay > 0.0:
            time.sleep(delay)
        while now() < t:
            pass


class VirtualClock:
    """Time that moves only when the loop waits for it, as fast as the machine can.

    Both its times start at ``start``, so that two runs with one seed are the same to the bit.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Virtual time [s]."""
        return self._now

    def wall(self) -> float:
        """Virtual time [s]: the virtual epoch is 1970."""
        return self._now

    def sleep_until(self, t: float) -> None:
        """Move time to ``t`` unless it is there already."""
        if t > self._now:
            self._now = t
