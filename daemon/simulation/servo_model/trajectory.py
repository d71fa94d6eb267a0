"""The trajectory a servo follows to its goal: velocity- and time-based profiles, stepped in time.

Plain numbers in counts and counts/s; it knows no register and no plant.
"""

from __future__ import annotations

import math

_NEAR = 1e-6  # counts: below it the square root's rounding would never let the trajectory arrive


class Profile:
    """Where the trajectory is and how fast it goes; a limit of 0 means none."""

    def __init__(self) -> None:
        self.position = 0.0  # counts
        self.velocity = 0.0  # counts/s
        self.target = 0.0
        self.speed = 0.0  # greatest velocity, 0 = at once
        self.acceleration = 0.0  # counts/s², 0 = at once

    @property
    def busy(self) -> bool:
        """Whether the trajectory still moves towards its target."""
        return self.position != self.target or self.velocity != 0.0

    def hold(self, position: float) -> None:
        """Stand still at a position."""
        self.position = self.target = position
        self.velocity = 0.0

    def aim(self, target: float, speed: float, acceleration: float) -> None:
        """Go to a target with these limits (velocity-based profile)."""
        self.target, self.speed, self.acceleration = target, speed, acceleration
        if speed == 0.0 and acceleration == 0.0:
            self.hold(target)

    def aim_in(self, target: float, duration: float, ramp: float) -> None:
        """Go to a target in ``duration`` seconds with ramps of ``ramp`` (time-based profile)."""
        if duration <= 0.0:
            self.hold(target)
            return
        ramp = min(ramp, duration / 2.0)
        speed = abs(target - self.position) / (duration - ramp)
        self.aim(target, speed, speed / ramp if ramp > 0.0 else 0.0)

    def step(self, dt: float) -> None:
        """Go on by dt [s]: a trapezoid, which never passes its target."""
        distance = self.target - self.position
        if distance == 0.0 and self.velocity == 0.0:
            return
        if abs(distance) < _NEAR and abs(self.velocity) <= max(self.acceleration * dt, _NEAR):
            self.hold(self.target)
            return
        limit = self.speed if self.speed > 0.0 else math.inf
        if self.acceleration > 0.0:
            # The speed from which it can still stop at the target, over the coming step too.
            a = self.acceleration
            stop = math.sqrt(2.0 * a * abs(distance) + (a * dt / 2.0) ** 2) - a * dt / 2.0
            wanted = math.copysign(min(limit, stop), distance)
            change = max(-a * dt, min(a * dt, wanted - self.velocity))
            velocity = self.velocity + change
        else:
            velocity = math.copysign(min(limit, abs(distance) / dt), distance)
        move = velocity * dt
        if distance * move >= 0.0 and abs(move) >= abs(distance):
            self.hold(self.target)
            return
        self.position += move
        self.velocity = velocity
