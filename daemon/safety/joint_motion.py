"""Check of a joint's angle against its velocity and against the speed that a joint can have.

An encoder whose zero jumps, that stands still while the joint turns or drifts while it rests, gives
angles that contradict the velocity beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from softfinger.daemon.types import Reading

_AT_ONCE = 0.02  # rad that an angle may go beyond the greatest velocity's way in one reading
_APART = 0.1  # rad that it may be off the way that the velocity says …
_MEMORY = 0.1  # … over the last so many s: a velocity lags
_LATE = 0.02  # s between two readings, or 3 ticks, from which on the sum begins again
_GAP = 0.1  # s from which on the step is not judged either


class JointMotion:
    """Follows the joints' readings; ``jumped`` has a bit for each finger where that is so now."""

    def __init__(self, fingers: Sequence[int], velocity_max: float, period: float) -> None:
        """``period`` [s] of the ticks."""
        self.jumped = 0
        self._fingers = tuple(fingers)
        self._velocity_max = velocity_max
        self._late = max(_LATE, 3.0 * period)
        self._gap = max(_GAP, self._late)
        self._requested = -math.inf  # when the last good reading was asked for [s]
        self._t = -math.inf  # and had come
        self._q = [0.0, 0.0]
        self._apart = [0.0, 0.0]  # rad

    def follow(self, requested: float, reading: Reading) -> None:
        """Take a reading in that was asked for at the time ``requested``."""
        self.jumped = 0
        t = reading.t
        if not reading.valid or t == self._t:
            return
        # Each was taken somewhere between question and answer.
        longest, dt = t - self._requested, t - self._t
        q, before, apart = reading.q, self._q, self._apart
        if longest < self._gap:
            limit = self._velocity_max * longest + _AT_ONCE
            keep = 1.0 - dt / _MEMORY if longest < self._late else 0.0
            for i in self._fingers:
                step = q[i] - before[i]
                before[i] = q[i]
                off = apart[i] = keep * (apart[i] + step - reading.dq[i] * dt)
                if not (-limit <= step <= limit and -_APART <= off <= _APART):
                    self.jumped |= 1 << i
                    apart[i] = 0.0
        else:
            before[:] = q
            apart[:] = 0.0, 0.0
        self._t, self._requested = t, requested
