"""One joint as the tick sees its servo: scale, bounds, and goals as the registers take them.

Numbers only; nothing is sent from here.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.examine import servo_name
from softfinger.daemon.servos.modes import current_toward
from softfinger.daemon.servos.units import JointScale

_CURRENT_AT, _POSITION_AT = reg.GOAL_CURRENT, reg.GOAL_POSITION
_CURRENT_AND_POSITION = struct.Struct("<hi")
_CURRENT = struct.Struct("<h")
_POSITION = struct.Struct("<i")
GOAL_SIZE: Final = {
    reg.CURRENT_BASED_POSITION_MODE: _CURRENT_AND_POSITION.size,
    reg.CURRENT_MODE: _CURRENT.size,
    reg.POSITION_MODE: _POSITION.size,
}


@dataclass(slots=True)
class Joint:
    """Finger, servo and what was last read of it."""

    finger: int
    id: int
    scale: JointScale
    bound: int = 0  # greatest goal current in counts
    ends: tuple[int, int] = (0, 0)  # position limits in counts
    q: float = 0.0  # of the last good reading [rad]
    dq: float = 0.0  # [rad/s]
    sent: deque[bytes] = field(default_factory=deque)  # the last goals, as registers take them
    ticks: int = -1  # of its own clock, when that was last looked at
    ticked: float = math.inf  # when that was last seen to go on, time.monotonic()

    @property
    def name(self) -> str:
        """How it is called in reports."""
        return servo_name(self.id, self.finger)

    def goal(self, servos: ServoSettings, mode: int, q: float, current: float) -> bytes:
        """A goal [rad, A] as the registers of this mode take it."""
        scale = self.scale
        if mode == reg.POSITION_MODE:
            low, high = self.ends
            return _POSITION.pack(min(max(scale.position_counts(q), low), high))
        bound = min(scale.bound_counts(current), self.bound)
        if mode == reg.CURRENT_BASED_POSITION_MODE:
            return _CURRENT_AND_POSITION.pack(bound, scale.position_counts(q))
        wanted = scale.current_counts(current_toward(servos, q, current, self.q, self.dq))
        return _CURRENT.pack(min(max(wanted, -bound), bound))


def pack_goal(mode: int, current: int, position: int) -> bytes:
    """A goal in counts as the registers of this mode take it."""
    if mode == reg.POSITION_MODE:
        return _POSITION.pack(position)
    if mode == reg.CURRENT_MODE:
        return _CURRENT.pack(current)
    return _CURRENT_AND_POSITION.pack(current, position)


def goal_in(mode: int, table: bytes, start: int) -> bytes:
    """The goal that a servo's registers hold; ``table`` has them from ``start`` on."""
    current = table[_CURRENT_AT - start : _CURRENT_AT - start + _CURRENT.size]
    position = table[_POSITION_AT - start : _POSITION_AT - start + _POSITION.size]
    if mode == reg.POSITION_MODE:
        return position
    return current if mode == reg.CURRENT_MODE else current + position
