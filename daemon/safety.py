"""The last stage before the servos: bounds on every goal, and the causes that latch a fault.

`Safety.bound` can't be bypassed: the loop sends nothing that has not been through it. Each cause
stands in one table, `Safety._CAUSES`; a cause that stands while torque is on latches a fault, and
``arm`` and ``clear`` are refused as long as one stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from daemon.modes import Mode
from daemon.records import FINGERS, Goal, State
from daemon.settings import Settings

_GRIPPING = frozenset({Mode.GRASPING, Mode.HOLDING, Mode.ROTATING})
_PAST_STOP = 0.1  # rad beyond a joint limit that a push may take a joint


class Safety:
    """Bounds goals and judges states. Needs no memory of its own but what the state carries."""

    def __init__(self, settings: Settings, has_servos: bool, has_sensors: bool) -> None:
        self._settings = settings
        self._limits = settings.safety
        self._fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self._has_servos = has_servos
        self._has_sensors = has_sensors
        self._frame_period = 1.0 / settings.tactile.rate
        self.overruns_in_row = 0  # kept by the loop

    def bound(self, goal: Goal) -> None:
        """Bound the goal in place; a goal that is not a number becomes invalid."""
        hand = self._settings.hand
        for index in self._fingers:
            q, current = goal.q[index], goal.current[index]
            if not (math.isfinite(q) and math.isfinite(current)):
                goal.valid = False
                return
            goal.q[index] = min(max(q, hand.q_min[index]), hand.q_max[index])
            goal.current[index] = min(max(current, 0.0), self._limits.current_max)

    def must_hold(self, state: State) -> bool:
        """Frames are late: the goals stay as they are until one comes or a fault latches."""
        if not self._has_sensors or state.mode not in _GRIPPING:
            return False
        return self._frames_older(state, self._limits.frame_age_hold)

    def cause(self, state: State, gripping: bool = False) -> str:
        """The first cause of a fault that stands in this state, or an empty text.

        Old frames are one while the hand grips, or when ``gripping`` says to judge as if it did.
        """
        for check in self._CAUSES:
            found = check(self, state)
            if found:
                return found
        return self._frames_silent(state) if gripping or state.mode in _GRIPPING else ""

    def mark_stale(self, state: State) -> None:
        """A contact whose last sound frame is older than a fault allows is not valid."""
        if not self._has_sensors:
            return
        oldest = state.t - self._limits.frame_age_fault * self._frame_period
        for index in self._fingers:
            contact = state.contacts[index]
            if contact.t_sound < oldest:
                contact.valid = False
                state.object.valid = False

    def _frames_older(self, state: State, periods: float) -> bool:
        oldest = state.t - periods * self._frame_period
        return any(state.contacts[index].t_sound < oldest for index in self._fingers)

    def _servos_silent(self, state: State) -> str:
        if not self._has_servos:
            return ""
        age = state.t - state.reading.t
        if age == math.inf:
            return "servos: no good reading yet"
        bound = self._settings.servos.fault_after
        return f"servos: no good reading for {age:.3f} s" if age > bound else ""

    def _servo_alert(self, state: State) -> str:
        if not self._has_servos or not state.reading.alert:
            return ""
        names = [FINGERS[i] for i in self._fingers if state.reading.alert >> i & 1]
        return f"servos: hardware error reported by {' and '.join(names)}"

    def _joints_outside(self, state: State) -> str:
        if not self._has_servos:
            return ""
        hand = self._settings.hand
        for index in self._fingers:
            q = state.reading.q[index]
            if not hand.q_min[index] - _PAST_STOP <= q <= hand.q_max[index] + _PAST_STOP:
                return f"{FINGERS[index]} joint at {q:.3f} rad, outside its limits"
            dq = state.reading.dq[index]
            if abs(dq) > self._limits.velocity_max:
                return f"{FINGERS[index]} joint at {dq:.2f} rad/s, too fast"
        return ""

    def _frames_silent(self, state: State) -> str:
        if not self._has_sensors or not self._frames_older(state, self._limits.frame_age_fault):
            return ""
        stalest = min(
            (state.contacts[i] for i in self._fingers), key=lambda contact: contact.t_sound
        )
        age = state.t - stalest.t_sound
        what = "frame" if stalest.t_arrival == stalest.t_sound else "sound estimate"
        return f"tactile: no {what} for {age:.3f} s"

    def _too_deep(self, state: State) -> str:
        if not self._has_sensors:
            return ""
        for index in self._fingers:
            contact = state.contacts[index]
            if not (contact.valid and contact.contact):
                continue
            name = FINGERS[index]
            if contact.force > self._limits.force_max:
                return f"{name} tip at {contact.force:.1f} N, above {self._limits.force_max:g} N"
            if contact.d > self._limits.d_max:
                return f"{name} tip at {contact.d * 1e3:.2f} mm, above {self._limits.d_max * 1e3:g}"
            # asin((a − d)/a): the object's plane reaches the rim of the tip's backing plate
            radius = self._settings.tip.radius
            limit = math.asin(max(1.0 - contact.d / radius, 0.0)) - self._limits.theta_margin
            if not contact.inside or abs(contact.theta) > limit:
                degrees = math.degrees(contact.theta)
                return (
                    f"{name} tip at {degrees:.1f}°, past {math.degrees(limit):.1f}° at this depth"
                )
        return ""

    def _overrunning(self, _: State) -> str:
        late = self.overruns_in_row
        return f"loop: {late} overruns in a row" if late >= self._limits.overruns_fault else ""

    _CAUSES: tuple[Callable[[Safety, State], str], ...] = (
        _servos_silent,
        _servo_alert,
        _joints_outside,
        _too_deep,
        _overrunning,
    )
