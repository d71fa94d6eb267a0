"""Between a servo's counts and a joint's SI units: the one mapping, used by backend and emulator.

q = direction · (counts − zero) · 2π / 4096 / gear_ratio, and likewise for velocity. Currents keep
the motor's own ampere; only the sign follows the joint, so that positive closes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos.models import ServoModel, by_name
from softfinger.daemon.servos.registers import COUNTS_PER_TURN, VELOCITY_UNIT

_GOAL_LIMIT = 1_048_575  # counts: the furthest goal the multi-turn modes take


@dataclass(frozen=True, slots=True)
class JointScale:
    """How one joint's counts map to rad, rad/s and A."""

    direction: int  # +1 or -1: sign of the counts when the joint closes
    zero: int  # counts at q = 0
    radian: float  # rad of the joint a position count, always > 0
    velocity: float  # rad/s of the joint a velocity count, always > 0
    current_unit: float  # A a current count

    @classmethod
    def of(cls, servos: ServoSettings, joint: int, model: ServoModel | None = None) -> JointScale:
        """The scale of joint 0 (left) or 1 (right) under the settings.

        Raises:
            KeyError: the settings name a model that is not in the table.
        """
        model = by_name(servos.model) if model is None else model
        return cls(
            direction=servos.direction[joint],
            zero=servos.zero[joint],
            radian=2.0 * math.pi / COUNTS_PER_TURN / servos.gear_ratio,
            velocity=VELOCITY_UNIT / servos.gear_ratio,
            current_unit=model.current_unit,
        )

    def angle(self, counts: float) -> float:
        """Joint angle [rad] of a position in counts."""
        return self.direction * (counts - self.zero) * self.radian

    def rate(self, counts: float) -> float:
        """Joint velocity [rad/s] of a velocity in counts."""
        return self.direction * counts * self.velocity

    def amperes(self, counts: float) -> float:
        """Motor current [A], positive closing, of a signed current in counts."""
        return self.direction * counts * self.current_unit

    def position_counts(self, q: float) -> int:
        """Position in counts nearest to the joint angle q [rad], kept inside what a goal takes."""
        counts = self.zero + self.direction * q / self.radian
        return round(min(max(counts, -_GOAL_LIMIT), _GOAL_LIMIT))

    def velocity_counts(self, dq: float) -> int:
        """Velocity in counts nearest to dq [rad/s]."""
        return round(self.direction * dq / self.velocity)

    def current_counts(self, current: float) -> int:
        """Signed current in counts nearest to a motor current [A] that is positive closing."""
        return round(self.direction * current / self.current_unit) if self.current_unit else 0

    def bound_counts(self, current: float) -> int:
        """Counts of a bound on the current's magnitude [A], rounded down so that it stays one."""
        return int(abs(current) / self.current_unit + 1e-9) if self.current_unit else 0
