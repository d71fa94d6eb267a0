"""Smooth setpoints: a target that may jump at any tick in, a jerk-limited way to it out.

Knows nothing of what the value means.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records

FloatArray = NDArray[np.float64]


class RunningMean(Record):
    """The mean of the last ``length`` values, which are kept beside it."""

    length: int
    index: int  # of the oldest value
    sum: float


class SetpointState(Record):
    """A setpoint and how it came there. The values under both means are kept beside it."""

    target: float
    value: float
    speed: float  # [1/s]
    ramp: float  # what goes to the target at the given rate
    idle: int  # ticks since it arrived there
    dt: float  # [s]
    first: RunningMean
    second: RunningMean


@inner_kernel
def reset(s: SetpointState, windows: FloatArray, value: float) -> None:
    """Be at ``value``, at rest."""
    s.target = s.ramp = s.value = value
    s.speed = 0.0
    s.idle = s.first.length + s.second.length
    s.first.index = 0
    s.second.index = 0
    s.first.sum = value * s.first.length
    s.second.sum = value * s.second.length
    windows[:] = value


@inner_kernel
def arrived(s: SetpointState) -> bool:
    """Return whether the setpoint is at rest at its target."""
    there: bool = s.idle >= s.first.length + s.second.length and s.ramp == s.target
    return there


@inner_kernel
def _add(mean: RunningMean, windows: FloatArray, start: int, value: float) -> float:
    """Take ``value`` into a mean whose window begins at ``start``."""
    index = mean.index
    mean.sum += value - windows[start + index]
    windows[start + index] = value
    mean.index = index + 1 if index + 1 < mean.length else 0
    result: float = mean.sum / mean.length
    return result


@inner_kernel
def advance(s: SetpointState, windows: FloatArray, rate: float) -> float:
    """Go on by one tick towards the target, at most ``rate`` a second; the new value."""
    left = s.target - s.ramp
    last = s.value
    if left == 0.0:
        length = s.first.length + s.second.length
        if s.idle >= length:
            return last
        s.idle += 1
        if s.idle >= length:
            reset(s, windows, s.target)  # the running sums' rounding ends here
            return s.target
    else:
        step_max = rate * s.dt
        s.idle = 0
        if abs(left) <= step_max:
            s.ramp = s.target
        else:
            s.ramp += step_max if left > 0.0 else -step_max
    smooth = _add(s.first, windows, 0, s.ramp)
    s.value = _add(s.second, windows, s.first.length, smooth)
    s.speed = (s.value - last) / s.dt
    return s.value


@kernel
def _step(setpoints: Records[SetpointState], windows: FloatArray, rate: float) -> bool:
    advance(setpoints[0], windows, rate)
    return arrived(setpoints[0])


@kernel
def _reset(setpoints: Records[SetpointState], windows: FloatArray, value: float) -> None:
    reset(setpoints[0], windows, value)


class Setpoint:
    """A ramp of bounded rate, averaged over two windows in turn.

    The first mean bounds the acceleration to rate/window, the second the jerk to
    rate/(window · window/2). The way never overshoots, whatever the stream of targets, and is at
    its target 1.5 windows after the ramp is.
    """

    def __init__(self, dt: float, window: float, state: SetpointState) -> None:
        """``dt`` is the tick and ``window`` the first mean's length [s]; kept in ``state``."""
        self.state = state
        self.state.dt = dt
        self.state.first.length = max(round(window / dt), 1)
        self.state.second.length = max(round(0.5 * window / dt), 1)
        self.windows = np.zeros(self.state.first.length + self.state.second.length)
        self.reset(0.0)
        self.step(0.0)  # nothing to do yet, but compiled now and by no tick

    def reset(self, value: float) -> None:
        """Be at ``value``, at rest."""
        _reset(self.state.array, self.windows, value)

    def step(self, rate: float) -> bool:
        """Go on by one tick, at most ``rate`` a second; whether it is at its target."""
        return _step(self.state.array, self.windows, rate)

    @property
    def target(self) -> float:
        """Target; it may be set at any tick."""
        return self.state.target

    @target.setter
    def target(self, value: float) -> None:
        self.state.target = value

    @property
    def value(self) -> float:
        """Present value."""
        return self.state.value

    @property
    def speed(self) -> float:
        """Present speed [1/s]."""
        return self.state.speed
