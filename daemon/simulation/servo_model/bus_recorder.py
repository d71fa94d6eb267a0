"""Record of what an emulated servo was sent, for tests of a daemon against its limits.

In counts as they came over the wire; a goal counts whether the servo took or refused it.
"""

from __future__ import annotations

from typing import Any

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.servo_model.servo_joint import POSITION_MODES, ServoJoint

FAR = 0.05  # rad between goal and present angle at torque on that count as far
_WATCHED = frozenset((reg.GOAL_CURRENT, reg.GOAL_POSITION))


class BusRecorder:
    """The record of one servo."""

    def __init__(self, t: float) -> None:
        self._goals: dict[int, tuple[int, int]] = {}  # register → least and greatest, counts
        self._refused = 0
        self._torque_on = 0  # how often
        self._torque_t: float | None = None
        self._far = 0
        self._farthest = 0.0  # rad
        self._current = 0.0  # A, greatest goal at torque on
        self._last = t  # when a packet was heard
        self._quiet = 0.0  # s, longest with torque on
        self._fired = 0
        self._fired_t: float | None = None
        self._off_t: float | None = None

    def goals(self, values: dict[int, int], joint: ServoJoint, torque: bool, refused: bool) -> None:
        """Record a write: values by register, but no angle near where a limp joint is."""
        goals = _WATCHED & values.keys()
        self._refused += refused and bool(goals)
        for address in goals:
            value = values[address]
            if address == reg.GOAL_POSITION and not torque and _away(joint, value) <= FAR:
                continue
            least, greatest = self._goals.get(address, (value, value))
            self._goals[address] = min(least, value), max(greatest, value)

    def torque_on(self, t: float, joint: ServoJoint, mode: int, goals: tuple[int, int]) -> None:
        """Record torque on at time t with these goals (position, current) in force, in counts."""
        position, current = goals
        self._torque_on += 1
        self._torque_t = self._last = t
        self._current = max(self._current, abs(joint.goal_current(current)))
        if mode in POSITION_MODES:
            away = _away(joint, position)
            self._far += away > FAR
            self._farthest = max(self._farthest, away)

    def torque_off(self, t: float) -> None:
        """Record torque off at time t."""
        self._off_t = t

    def heard(self, t: float, torque: bool) -> None:
        """Record a packet at time t that the servo understood."""
        if torque and t - self._last > self._quiet:
            self._quiet = t - self._last
        self._last = t

    def fired(self, t: float) -> None:
        """Record that the bus watchdog stopped the motor."""
        self._fired += 1
        self._fired_t = t

    def report(self, t: float, joint: ServoJoint, torque: bool) -> dict[str, Any]:
        """Return the record at time t, in SI and in the joint's sense, as JSON takes it."""
        angles = [joint.goal_angle(each) for each in self._goals.get(reg.GOAL_POSITION, ())]
        currents = [joint.goal_current(each) for each in self._goals.get(reg.GOAL_CURRENT, ())]
        quiet = t - self._last
        return {
            "goal_q": sorted(angles) or None,
            "goal_current": sorted(currents) or None,
            "goals_refused": self._refused,
            "torque_on": {
                "count": self._torque_on,
                "t": self._torque_t,
                "far": self._far,
                "farthest": self._farthest,
                "current": self._current,
            },
            "torque_off": self._off_t,
            "quiet": quiet if torque else None,
            "longest_quiet": max(self._quiet, quiet) if torque else self._quiet,
            "watchdog_fired": {"count": self._fired, "t": self._fired_t},
        }


def _away(joint: ServoJoint, position: int) -> float:
    """Return how far a goal is from where the joint is [rad]."""
    return abs(joint.goal_angle(position) - joint.goal_angle(joint.position()))
