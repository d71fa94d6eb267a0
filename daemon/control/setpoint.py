"""Smooth references: a target that may jump at any tick in, a jerk-limited way to it out.

Holds `Reference`, the kernels on its memory, and nothing that knows what the value means.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

FloatArray = NDArray[np.float64]

# Places in a reference's memory; the windows of both means follow behind.
TARGET, VALUE, SPEED = 0, 1, 2
_RAMP, _IDLE, _DT = 3, 4, 5  # _IDLE: ticks since the ramp arrived
_FIRST, _SECOND = 6, 9  # of each mean: its window's length, the place in it, the window's sum
_WINDOWS = 12


@kernel
def reset(r: FloatArray, value: float) -> None:
    """Be at ``value``, at rest."""
    r[TARGET] = r[_RAMP] = r[VALUE] = value
    r[SPEED] = 0.0
    r[_IDLE] = r[_FIRST] + r[_SECOND]
    for mean in (_FIRST, _SECOND):
        r[mean + 1] = 0.0
        r[mean + 2] = value * r[mean]
    for k in range(_WINDOWS, r.shape[0]):
        r[k] = value


@kernel
def arrived(r: FloatArray) -> bool:
    """At the target, at rest."""
    there: bool = r[_IDLE] >= r[_FIRST] + r[_SECOND] and r[_RAMP] == r[TARGET]
    return there


@inner_kernel
def _mean(r: FloatArray, mean: int, window: int, value: float) -> float:
    """Take ``value`` into a running mean whose window begins at ``window``."""
    at = int(r[mean + 1])
    r[mean + 2] += value - r[window + at]
    r[window + at] = value
    r[mean + 1] = at + 1.0 if at + 1.0 < r[mean] else 0.0
    result: float = r[mean + 2] / r[mean]
    return result


@kernel
def advance(r: FloatArray, rate: float) -> float:
    """One tick on towards the target, at most ``rate`` a second; returns the value."""
    left = r[TARGET] - r[_RAMP]
    last: float = r[VALUE]
    if left == 0.0:
        length = r[_FIRST] + r[_SECOND]
        if r[_IDLE] >= length:
            return last
        r[_IDLE] += 1.0
        if r[_IDLE] >= length:
            last = r[TARGET]
            reset(r, last)  # the running sums' rounding ends here
            return last
    else:
        most = rate * r[_DT]
        r[_IDLE] = 0.0
        if abs(left) <= most:
            r[_RAMP] = r[TARGET]
        else:
            r[_RAMP] += most if left > 0.0 else -most
    smooth = _mean(r, _FIRST, _WINDOWS, r[_RAMP])
    value = _mean(r, _SECOND, _WINDOWS + int(r[_FIRST]), smooth)
    r[VALUE] = value
    r[SPEED] = (value - last) / r[_DT]
    return value


class Reference:
    """A ramp of bounded rate, averaged over two windows in turn.

    The first mean bounds the acceleration to rate/window, the second the jerk to
    rate/(window · window/2). The way never overshoots, whatever the stream of targets, and is at
    its target 1.5 windows after the ramp is.
    """

    def __init__(self, dt: float, window: float) -> None:
        """``dt`` is the tick and ``window`` the first mean's length [s]."""
        first, second = max(round(window / dt), 1), max(round(0.5 * window / dt), 1)
        self.memory = np.zeros(_WINDOWS + first + second)
        self.memory[_DT] = dt
        self.memory[_FIRST] = first
        self.memory[_SECOND] = second
        self.reset(0.0)
        advance(self.memory, 0.0)  # nothing to do yet, but compiled now and by no tick
        arrived(self.memory)

    def reset(self, value: float) -> None:
        """Be at ``value``, at rest."""
        reset(self.memory, value)

    @property
    def target(self) -> float:
        """Where it goes to; it may be set at any tick."""
        return self.memory.item(TARGET)

    @target.setter
    def target(self, value: float) -> None:
        self.memory[TARGET] = value

    @property
    def value(self) -> float:
        """Where it is."""
        return self.memory.item(VALUE)

    @property
    def speed(self) -> float:
        """How fast it moves [1/s]."""
        return self.memory.item(SPEED)

    @property
    def arrived(self) -> bool:
        """At the target, at rest."""
        return bool(arrived(self.memory))

    def step(self, rate: float) -> float:
        """One tick on towards the target, at most ``rate`` a second; returns the value."""
        return advance(self.memory, rate)
