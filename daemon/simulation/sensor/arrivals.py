"""When a simulated sensor's frames arrive: each after a delay, some late, some never.

Seeded, and the same whoever asks how often: chance is drawn frame by frame.
"""

from __future__ import annotations

import numpy as np


class Arrivals:
    """The frames 0, 1, … of a sensor that samples one every ``period`` [s] from ``start`` [s] on.

    Frame k is due at start + k · period + ``delay``. With the probability ``dropped`` it never
    comes, and it comes later by an even chance of up to ``jitter`` [s], and not before one that was
    sampled earlier: it waits for that.
    """

    # A few roundings of the clock's value, so that a frame due now counts as come.
    _SLACK = 1e-9

    def __init__(
        self,
        start: float,
        period: float,
        delay: float,
        dropped: float = 0.0,
        jitter: float = 0.0,
        seed: tuple[int, ...] = (0,),
    ) -> None:
        self._start = start
        self._period = period
        self._delay = delay
        self._dropped = dropped
        self._jitter = jitter
        self._random = np.random.default_rng(seed)
        self.number = -1  # of the newest frame that arrived
        self.arrival = start  # and when it did [s]
        self.arrived = 0  # frames
        self.missed = 0  # frames before the newest that never came
        self._next = -1
        self.next_arrival = start + delay  # of the frame after the newest [s]
        self._plan()

    def take(self, now: float) -> bool:
        """Let time pass until ``now`` [s]; True when a newer frame has arrived."""
        newest = self.number
        while self.next_arrival <= now + self._SLACK:
            self.missed += self._next - self.number - 1
            self.number = self._next
            self.arrival = self.next_arrival
            self.arrived += 1
            self._plan()
        return self.number > newest

    def _plan(self) -> None:
        """Find the next frame that comes."""
        self._next += 1
        while self._dropped > 0.0 and self._random.random() < self._dropped:
            self._next += 1
        due = self._start + self._next * self._period + self._delay
        if self._jitter > 0.0:
            due += self._jitter * self._random.random()
        self.next_arrival = max(due, self.arrival)
