"""Smooth references: a target that may jump at any tick in, a jerk-limited way to it out.

Holds `Reference` and nothing that knows what the value means.
"""

from __future__ import annotations


class _Mean:
    """Mean of the last ``count`` values, one a tick."""

    def __init__(self, count: int) -> None:
        self.count = max(count, 1)
        self.reset(0.0)

    def reset(self, value: float) -> None:
        self._values = [value] * self.count
        self._sum = value * self.count
        self._at = 0

    def step(self, value: float) -> float:
        at = self._at
        self._sum += value - self._values[at]
        self._values[at] = value
        self._at = at + 1 if at + 1 < self.count else 0
        return self._sum / self.count


class Reference:
    """A ramp of bounded rate, averaged over two windows in turn.

    The first mean bounds the acceleration to rate/window, the second the jerk to
    rate/(window · window/2). The way never overshoots, whatever the stream of targets, and is at
    its target 1.5 windows after the ramp is.
    """

    def __init__(self, dt: float, window: float) -> None:
        """``dt`` is the tick and ``window`` the first mean's length [s]."""
        self._dt = dt
        self._means = _Mean(round(window / dt)), _Mean(round(0.5 * window / dt))
        self._length = self._means[0].count + self._means[1].count
        self.reset(0.0)

    def reset(self, value: float) -> None:
        """Be at ``value``, at rest."""
        self.target = self._ramp = self.value = value
        self.speed = 0.0
        self._idle = self._length  # ticks since the ramp arrived
        for mean in self._means:
            mean.reset(value)

    @property
    def arrived(self) -> bool:
        """At the target, at rest."""
        return self._idle >= self._length and self._ramp == self.target

    def step(self, rate: float) -> float:
        """One tick on towards the target, at most ``rate`` a second; returns the value."""
        left = self.target - self._ramp
        if left == 0.0:
            if self._idle >= self._length:
                return self.value
            self._idle += 1
            if self._idle >= self._length:
                self.reset(self.target)  # the running sums' rounding ends here
                return self.value
        else:
            most = rate * self._dt
            self._idle = 0
            self._ramp = (
                self.target if abs(left) <= most else self._ramp + (most if left > 0.0 else -most)
            )
        last = self.value
        self.value = self._means[1].step(self._means[0].step(self._ramp))
        self.speed = (self.value - last) / self._dt
        return self.value
