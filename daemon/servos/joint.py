"""Represent a joint and its servo: unit conversion, limits, last reading and encoded goals."""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.types import FINGERS

_GOAL_LIMIT = 1_048_575  # maximum goal in multi-turn modes [counts]
_CURRENT_AND_POSITION = struct.Struct("<hi")
# Part of the bytes of goal current and goal position that an operating mode uses.
_GOAL: Final = {
    reg.CURRENT_BASED_POSITION_MODE: slice(0, 6),
    reg.CURRENT_MODE: slice(0, 2),
    reg.POSITION_MODE: slice(2, 6),
}
GOAL_SIZE: Final = {mode: part.stop - part.start for mode, part in _GOAL.items()}


def servo_name(servo_id: int, finger: int) -> str:
    """Return a servo's name for reports, such as ``servo 1 (left)``."""
    return f"servo {servo_id} ({FINGERS[finger]})"


def current_toward(
    servos: ServoSettings, goal_q: float, bound: float, q: float, dq: float
) -> float:
    """Return the current that the position loop commands in current mode [A].

    The current is stiffness · (goal_q − q) − damping · dq, limited to ± ``bound``. A positive
    current closes the joint.
    """
    bound = abs(bound)
    current = servos.stiffness * (goal_q - q) - servos.damping * dq
    return min(max(current, -bound), bound)


@dataclass(frozen=True, slots=True)
class JointScale:
    """Conversion between register counts and rad, rad/s and A.

    A joint angle is direction · (counts − zero) · 2π / 4096 / gear_ratio. Velocities are converted
    similarly. Currents are motor currents and do not depend on the gear ratio. A positive current
    closes the joint.
    """

    direction: int  # +1 if the counts increase when the joint closes, otherwise -1
    zero: int  # position counts at q = 0
    radian: float  # joint rotation per position count [rad], always > 0
    velocity: float  # joint velocity per velocity count [rad/s], always > 0
    current_unit: float  # A per current count

    @classmethod
    def of(cls, servos: ServoSettings, joint: int, model: ServoModel) -> JointScale:
        """Return the scale of joint 0 (left) or 1 (right) from the settings."""
        return cls(
            direction=servos.direction[joint],
            zero=servos.zero[joint],
            radian=2.0 * math.pi / reg.COUNTS_PER_TURN / servos.gear_ratio,
            velocity=reg.VELOCITY_UNIT / servos.gear_ratio,
            current_unit=model.current_unit,
        )

    def angle(self, counts: float) -> float:
        """Convert a position [counts] to a joint angle [rad]."""
        return self.direction * (counts - self.zero) * self.radian

    def rate(self, counts: float) -> float:
        """Convert a velocity [counts] to a joint velocity [rad/s]."""
        return self.direction * counts * self.velocity

    def amperes(self, counts: float) -> float:
        """Convert a signed current [counts] to a motor current [A], positive when closing."""
        return self.direction * counts * self.current_unit

    def position_counts(self, q: float) -> int:
        """Convert a joint angle [rad] to the nearest count within the goal range."""
        counts = self.zero + self.direction * q / self.radian
        return round(min(max(counts, -_GOAL_LIMIT), _GOAL_LIMIT))

    def velocity_counts(self, dq: float) -> int:
        """Convert a joint velocity [rad/s] to the nearest count."""
        return round(self.direction * dq / self.velocity)

    def current_counts(self, current: float) -> int:
        """Convert a motor current [A], positive when closing, to the nearest signed count."""
        return round(self.direction * current / self.current_unit) if self.current_unit else 0

    def bound_counts(self, current: float) -> int:
        """Convert a current limit [A] to counts, rounded down."""
        return int(abs(current) / self.current_unit + 1e-9) if self.current_unit else 0


@dataclass(slots=True)
class Joint:
    """State of a finger's joint on the servo bus."""

    finger: int
    id: int
    scale: JointScale
    firmware: int = 0
    bound: int = 0  # maximum goal current in counts
    ends: tuple[int, int] = (-_GOAL_LIMIT, _GOAL_LIMIT)  # position limits in counts
    q: float = 0.0  # angle in the last valid reading [rad]
    dq: float = 0.0  # [rad/s]
    sent: deque[bytes] = field(default_factory=deque)  # recently sent goals as register bytes
    ticks: int = -1  # value of the servo clock at the last check
    ticked: float = math.inf  # time when the servo clock last advanced [s]

    @classmethod
    def of(cls, servos: ServoSettings, finger: int, model: ServoModel) -> Joint:
        """Return the joint of finger 0 (left) or 1 (right) from the settings."""
        return cls(finger, servos.ids[finger], JointScale.of(servos, finger, model))

    @property
    def name(self) -> str:
        """Servo name for reports."""
        return servo_name(self.id, self.finger)

    def goal(self, servos: ServoSettings, mode: int, q: float, current: float) -> tuple[int, int]:
        """Return goal current and goal position [counts] for a goal [rad, A].

        In operating mode 5, the goal current is a limit and therefore positive.
        """
        scale, position = self.scale, self.scale.position_counts(q)
        counts = bound = min(scale.bound_counts(current), self.bound)
        if mode == reg.POSITION_MODE:
            position = min(max(position, self.ends[0]), self.ends[1])
        elif mode == reg.CURRENT_MODE:
            counts = scale.current_counts(current_toward(servos, q, current, self.q, self.dq))
            counts = min(max(counts, -bound), bound)
        return counts, position


def pack_goal(mode: int, current: int, position: int) -> bytes:
    """Return the register bytes for a goal [counts] in operating mode ``mode``."""
    return _CURRENT_AND_POSITION.pack(current, position)[_GOAL[mode]]


def goal_in(mode: int, table: bytes, start: int) -> bytes:
    """Return a servo's goal bytes. ``table`` contains the registers from address ``start`` on."""
    current, position = reg.GOAL_CURRENT - start, reg.GOAL_POSITION - start
    return (table[current : current + 2] + table[position : position + 4])[_GOAL[mode]]
