"""The operating modes in which the backends run the joints, by the settings' names.

What a goal means in each of them is told in :mod:`servos.base`. Pure functions and numbers.
"""

from __future__ import annotations

from typing import Final

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos import registers as reg

NUMBERS: Final = {
    "current-based position": reg.CURRENT_BASED_POSITION_MODE,
    "current": reg.CURRENT_MODE,
    "position": reg.POSITION_MODE,
}


def mode_number(servos: ServoSettings) -> int:
    """Dynamixel's number of the settings' mode."""
    return NUMBERS[servos.mode]


def current_toward(
    servos: ServoSettings, goal_q: float, bound: float, q: float, dq: float
) -> float:
    """Current [A], positive closing, that draws a joint to its goal: current mode's position loop.

    stiffness · (goal_q − q) − damping · dq, within ± ``bound``.
    """
    bound = abs(bound)
    current = servos.stiffness * (goal_q - q) - servos.damping * dq
    return min(max(current, -bound), bound)
