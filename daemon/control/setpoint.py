"""Generate smooth, jerk-limited setpoints for a target that may jump.

The values may have any unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records

FloatArray = NDArray[np.float64]


class RunningMean(Record):
    """Running mean of the last ``length`` values; a separate array stores the values."""

    length: int
    index: int  # index of the oldest value
    sum: float


class SetpointState(Record):
    """State of a setpoint. A separate array stores the averaged values."""

    target: float
    value: float
    speed: float  # [1/s]
    ramp: float  # unsmoothed value, which approaches the target at a constant rate
    pending_count: int  # number of ticks until the running means have settled
    dt: float  # [s]
    first: RunningMean
    second: RunningMean


@inner_kernel
def reset(s: SetpointState, windows: FloatArray, value: float) -> None:
    """Set the setpoint to ``value``, and set its speed to zero."""
    s.target = s.ramp = s.value = value
    s.speed = 0.0
    s.pending_count = 0
    s.first.index = 0
    s.second.index = 0
    s.first.sum = value * s.first.length
    s.second.sum = value * s.second.length
    windows[:] = value


@inner_kernel
def has_arrived(s: SetpointState) -> bool:
    """Return True if the setpoint has reached its target and stopped."""
    there: bool = s.pending_count == 0 and s.ramp == s.target
    return there


@inner_kernel
def _add(mean: RunningMean, windows: FloatArray, start: int, value: float) -> float:
    """Add ``value`` to the running mean whose window begins at ``start``; return the mean."""
    index = mean.index
    mean.sum += value - windows[start + index]
    windows[start + index] = value
    mean.index = index + 1 if index + 1 < mean.length else 0
    result: float = mean.sum / mean.length
    return result


@inner_kernel
def advance(s: SetpointState, windows: FloatArray, rate: float) -> float:
    """Advance towards the target by one tick at up to ``rate`` [1/s]; return the new value."""
    remaining = s.target - s.ramp
    last = s.value
    if remaining == 0.0:
        if s.pending_count == 0:
            return last
        s.pending_count -= 1
        if s.pending_count == 0:
            reset(s, windows, s.target)  # Remove accumulated rounding errors.
            return s.target
    else:
        step_max = rate * s.dt
        s.pending_count = s.first.length + s.second.length
        if abs(remaining) <= step_max:
            s.ramp = s.target
        else:
            s.ramp += step_max if remaining > 0.0 else -step_max
    smooth = _add(s.first, windows, 0, s.ramp)
    s.value = _add(s.second, windows, s.first.length, smooth)
    s.speed = (s.value - last) / s.dt
    return s.value


@kernel
def _step(setpoints: Records[SetpointState], windows: FloatArray, rate: float) -> bool:
    advance(setpoints[0], windows, rate)
    return has_arrived(setpoints[0])


@kernel
def _reset(setpoints: Records[SetpointState], windows: FloatArray, value: float) -> None:
    reset(setpoints[0], windows, value)


class Setpoint:
    """Rate-limited ramp, smoothed by two running means in series.

    The first mean limits the acceleration to rate/window. The second mean limits the jerk to
    rate/(window · window/2). The value never overshoots, even if the target changes repeatedly. The
    value reaches the target 1.5 · window after the ramp reaches the target.
    """

    def __init__(self, dt: float, window: float, state: SetpointState) -> None:
        """Create a setpoint with a tick period ``dt`` and an averaging time ``window`` [s]."""
        self.state = state
        self.state.dt = dt
        self.state.first.length = max(round(window / dt), 1)
        self.state.second.length = max(round(0.5 * window / dt), 1)
        self.windows = np.zeros(self.state.first.length + self.state.second.length)
        self.reset(0.0)
        self.step(0.0)  # Compile the kernel before the first tick.

    def reset(self, value: float) -> None:
        """Set the setpoint to ``value``, and set its speed to zero."""
        _reset(self.state.array, self.windows, value)

    def step(self, rate: float) -> bool:
        """Advance by one tick at up to ``rate`` [1/s]; return True if the target is reached."""
        return _step(self.state.array, self.windows, rate)

    @property
    def target(self) -> float:
        """Target value, which may change on any tick."""
        return self.state.target

    @target.setter
    def target(self, value: float) -> None:
        self.state.target = value

    @property
    def value(self) -> float:
        """Current value."""
        return self.state.value

    @property
    def speed(self) -> float:
        """Current speed [1/s]."""
        return self.state.speed
