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
    """The machine's monotonic clock."""

    now = staticmethod(time.monotonic)
    wall = staticmethod(time.time)

    def sleep_until(self, t: float) -> None:
        """Sleep; a signal handler may run meanwhile, and the sleep goes on after it."""
        delay = t - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)


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
