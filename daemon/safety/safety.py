"""Check every state, limit every goal, and send the goals to the servos.

Goals reach the bus only through `Safety.write`, which applies the goal limits. The
`safety.limits.LIMITS` table defines the checks. This module schedules the checks and reports each
warning once. A violation must last long enough before it raises a fault.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from softfinger.daemon.control.modes import GRIPPING_MODES, Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.limits import LIMITS, Check, Limit, View
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.types import Goal, State

_REPEAT_TIME = 1.0  # time without a violation after which a warning may be repeated [s]
_HYSTERESIS = 0.95  # fraction of the bound below which a reported warning clears

BUS = "servos.bus"  # name of the limit under which servo backend errors are reported
TORQUE_OFF = "torque.off"  # name of the limit that reports unconfirmed torque off


class Breach(NamedTuple):
    """Name of a violated limit and description of the violation."""

    name: str
    text: str


class _Watch:
    """Monitor that checks one limit and measures how long a violation lasts."""

    def __init__(self, limit: Limit, check: Check, view: View) -> None:
        self.limit = limit
        self.check = check
        lasts = limit.lasts
        self.lasts = getattr(view.limits, lasts) if isinstance(lasts, str) else lasts
        self.since = math.inf  # start time of the violation [s], or inf if there is none
        self.reported = False
        self._ended = -math.inf

    def check_limit(
        self, view: View, state: State, faults: set[_Watch], warnings: list[Breach]
    ) -> None:
        """Run the check, and record a violation that has lasted long enough."""
        limit = self.limit
        found = self.check(view, state, limit.fraction * (_HYSTERESIS if self.reported else 1.0))
        if not found:
            if self.since < math.inf:
                self.since = math.inf
                self._ended = state.t
                faults.discard(self)
            if self.reported and state.t - self._ended > _REPEAT_TIME:
                self.reported = False
            return
        self.since = min(self.since, state.t)
        if state.t - self.since < self.lasts:
            return
        if limit.level == "fault":
            faults.add(self)
        elif not self.reported:
            self.reported = True
            warnings.append(Breach(limit.name, found))


class Safety:
    """State checker and goal limiter. Only the loop thread may use this class."""

    def __init__(
        self,
        settings: Settings,
        grasp: GraspState,
        sensors: Sequence[FingerPerception],
    ) -> None:
        """Create the checks, which read ``grasp`` and ``sensors`` but never modify them."""
        view = self._view = View(settings, grasp, sensors)
        limits, hand = settings.safety, settings.hand
        self._limits = limits
        self._has_sensors = settings.tactile.backend != "none"
        has_servos = settings.servos.backend != "none"
        there = {"": True, "servos": has_servos, "sensors": self._has_sensors}
        watches = [
            _Watch(limit, limit.check, view)
            for limit in LIMITS
            if limit.check is not None and there[limit.needs]
        ]
        self._each_tick = [watch for watch in watches if not watch.limit.in_turn]
        self._in_turn = [watch for watch in watches if watch.limit.in_turn]
        # Keep the order of the table, because the first violation determines the name of the fault.
        self._faults = [watch for watch in watches if watch.limit.level == "fault"]
        self._turn = 0
        self._found: set[_Watch] = set()  # fault limits that were violated when last checked
        self.must_hold = False  # True if a grip's goal must not change because frames are late
        self.warnings: list[Breach] = []  # new warnings, which the loop reports and removes
        self.limited: Counter[str] = Counter()  # number of ticks with a modified goal, per limit
        self._hold_age = limits.frame_age_hold / settings.tactile.rate
        dt = 1.0 / settings.loop.rate
        self._step = limits.goal_speed * dt
        # In position mode, the current limit does not reduce the effect of a goal jump.
        self._travel = 0.0 if settings.servos.mode == "position" else limits.goal_reach
        self._rise = limits.current_rate * dt
        self._ends = [(i, hand.q_min[i], hand.q_max[i]) for i in view.fingers]
        self._sent_q = [0.0, 0.0]
        self._sent_current = [0.0, 0.0]
        self._sent_seq = -2

    # Checks of the state

    def judge(self, state: State) -> Breach | None:
        """Check the state of the current tick, and return the first fault or None.

        New warnings are appended to ``warnings``.
        """
        view, found = self._view, self._found
        view.update(state)
        for watch in self._each_tick:
            watch.check_limit(view, state, found, self.warnings)
        if self._in_turn:
            self._turn = (self._turn + 1) % len(self._in_turn)
            self._in_turn[self._turn].check_limit(view, state, found, self.warnings)
        gripping = state.mode in GRIPPING_MODES
        oldest, contacts = state.t - self._hold_age, state.contacts
        late = any(contacts[i].t_valid < oldest for i in view.fingers)
        self.must_hold = gripping and self._has_sensors and late
        if self.must_hold:
            self._count("tactile.late")
        breach = None
        if found:
            for watch in self._faults:
                applies = watch in found and (gripping or not watch.limit.gripping)
                # The violation may have ended since a limit was last checked in turn.
                if applies and (text := watch.check(view, state, watch.limit.fraction)):
                    breach = Breach(watch.limit.name, text)
                    break
        view.bad_goal = False
        return breach

    def cause(self, state: State, gripping: bool = False) -> str:
        """Return the first fault that would block a command in ``state``, or "" if there is none.

        If ``gripping`` is True, the limits that apply during a grip are checked in every mode. The
        state is not modified.
        """
        gripping = gripping or state.mode in GRIPPING_MODES
        view = self._view
        for watch in self._faults:
            if watch.limit.gripping and not gripping:
                continue
            lasted = state.t - min(watch.since, state.t) >= watch.lasts
            if lasted and (found := watch.check(view, state, watch.limit.fraction)):
                return found
        return ""

    def opens_first(self, breach: Breach, mode: Mode | str) -> bool:
        """Return True if the hand must open before this fault turns torque off."""
        commanded = self._limits.frame_age_action == "open"
        return commanded and breach.name == "tactile.silent" and mode in GRIPPING_MODES

    # Goals

    def write(self, servos: Servos, state: State) -> None:
        """Limit the goal in place and send the goal to the servos.

        A goal that is not finite is marked as invalid and is not sent.

        Raises ServoError like `Servos.write`.
        """
        goal = state.goal
        q, current = goal.q, goal.current
        present = state.reading.q
        if state.seq - self._sent_seq != 1:  # Torque was off, so start with zero current.
            self._sent_q[:] = present
            self._sent_current[:] = (0.0, 0.0)
        self._sent_seq = state.seq
        for i, low, high in self._ends:
            self._bound_goal(goal, i, low, high, present[i])
            if not goal.valid:
                return
            self._sent_q[i] = q[i]
            self._sent_current[i] = current[i]
        servos.write(goal)

    def _bound_goal(self, goal: Goal, i: int, low: float, high: float, present: float) -> None:
        q, current = goal.q[i], goal.current[i]
        if not (math.isfinite(q) and math.isfinite(current)):
            goal.valid = False
            self._view.bad_goal = True
            return
        inside = min(max(q, low), high)
        if inside != q:
            self._count("goal.angle")
        sent = self._sent_q[i]
        lowest = min(sent, present - self._travel) - self._step
        highest = max(sent, present + self._travel) + self._step
        near = min(max(inside, lowest), highest)
        if near != inside:
            self._count("goal.step")
        # Apply the joint limits last so that no other step overrides them.
        goal.q[i] = min(max(near, low), high)
        limit = min(max(current, 0.0), self._limits.current_max)
        if limit != current:
            self._count("goal.current")
        slow = min(limit, self._sent_current[i] + self._rise)
        if slow != limit:
            self._count("goal.slew")
        goal.current[i] = slow

    def _count(self, name: str) -> None:
        self.limited[name] += 1
