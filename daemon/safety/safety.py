"""The last stage before the servos: judges every state, bounds every goal, and sends it.

`Safety.write` is the only way from a goal to the bus, and bounds what it sends. What is judged
stands in one table, `safety.limits.LIMITS`; here stands when, that a warning is reported once, and
how long something must last to be a fault.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from softfinger.daemon.control.modes import GRIPPING, Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.limits import LIMITS, Check, Limit, View
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.types import Goal, State

_AGAIN = 1.0  # s after which a warning that was over may be reported again
_EASE = 0.95  # hysteresis: what was reported stands until it falls below so much of its bound

BUS = "servos.bus"  # the limit of what the servo backend itself refuses
TORQUE_OFF = "torque.off"  # of torque off that is not confirmed, `safety.torque_state`


class Breach(NamedTuple):
    """A limit that is broken: its name, and what was found."""

    name: str
    text: str


class _Watch:
    """One limit of a scene, and since when it is broken."""

    def __init__(self, limit: Limit, check: Check, view: View) -> None:
        self.limit = limit
        self.check = check
        lasts = limit.lasts
        self.lasts = getattr(view.limits, lasts) if isinstance(lasts, str) else lasts
        self.since = math.inf  # broken since then, inf: it is not
        self.reported = False
        self._ended = -math.inf

    def check_limit(
        self, view: View, state: State, faults: dict[_Watch, str], warnings: list[Breach]
    ) -> None:
        """Enter what stands at this tick and has for long enough; keeps count of how long."""
        limit = self.limit
        found = self.check(view, state, limit.fraction * (_EASE if self.reported else 1.0))
        if not found:
            if self.since < math.inf:
                self.since = math.inf
                self._ended = state.t
                faults.pop(self, None)
            if self.reported and state.t - self._ended > _AGAIN:
                self.reported = False
            return
        self.since = min(self.since, state.t)
        if state.t - self.since < self.lasts:
            return
        if limit.level == "fault":
            faults[self] = found
        elif not self.reported:
            self.reported = True
            warnings.append(Breach(limit.name, found))


class Safety:
    """Judges states and bounds goals. One thread, the loop's, may call it."""

    def __init__(
        self,
        settings: Settings,
        has_servos: bool,
        has_sensors: bool,
        grasp: GraspState | None = None,
        sensors: Sequence[FingerPerception] = (),
    ) -> None:
        """``grasp`` and ``sensors`` are the loop's own, looked at and never changed."""
        view = self._view = View(settings, grasp, sensors)
        limits, hand = settings.safety, settings.hand
        self._limits = limits
        self._has_sensors = has_sensors
        there = {"": True, "servos": has_servos, "sensors": has_sensors}
        watches = [
            _Watch(limit, limit.check, view)
            for limit in LIMITS
            if limit.check is not None and there[limit.needs]
        ]
        self._each_tick = [watch for watch in watches if not watch.limit.in_turn]
        self._in_turn = [watch for watch in watches if watch.limit.in_turn]
        # In the table's order: the first one that stands is the fault's name.
        self._faults = [watch for watch in watches if watch.limit.level == "fault"]
        self._turn = 0
        self._found: dict[_Watch, str] = {}  # faults that stand
        self.must_hold = False  # frames are late in a grip: nothing is moved on
        self.warnings: list[Breach] = []  # to be reported; the loop empties it
        self.limited: Counter[str] = Counter()  # ticks in which a goal was changed, by limit
        self._hold_age = limits.frame_age_hold / settings.tactile.rate
        dt = 1.0 / settings.loop.rate
        self._step = limits.goal_speed * dt
        # In position mode no current bounds what a jump does.
        self._travel = 0.0 if settings.servos.mode == "position" else limits.goal_reach
        self._rise = limits.current_rate * dt
        self._ends = [(i, hand.q_min[i], hand.q_max[i]) for i in view.fingers]
        self._sent_q = [0.0, 0.0]
        self._sent_current = [0.0, 0.0]
        self._sent_seq = -2

    # Judging

    def judge(self, state: State) -> Breach | None:
        """Look at this tick's state; the first fault that stands, if any.

        Warnings that are new are added to ``warnings``.
        """
        view, found = self._view, self._found
        view.follow(state)
        for watch in self._each_tick:
            watch.check_limit(view, state, found, self.warnings)
        view.bad_goal = False
        if self._in_turn:
            self._turn = (self._turn + 1) % len(self._in_turn)
            self._in_turn[self._turn].check_limit(view, state, found, self.warnings)
        gripping = state.mode in GRIPPING
        oldest, contacts = state.t - self._hold_age, state.contacts
        late = any(contacts[i].t_valid < oldest for i in view.fingers)
        self.must_hold = gripping and self._has_sensors and late
        if self.must_hold:
            self._count("tactile.late")
        if found:
            for watch in self._faults:
                if watch in found and (gripping or not watch.limit.gripping):
                    return Breach(watch.limit.name, found[watch])
        return None

    def cause(self, state: State, gripping: bool = False) -> str:
        """Return the first fault in this state, or an empty text: what refuses a command.

        With ``gripping`` the limits of a grip are judged, whatever the mode. Nothing is changed.
        """
        gripping = gripping or state.mode in GRIPPING
        view = self._view
        for watch in self._faults:
            if watch.limit.gripping and not gripping:
                continue
            lasted = state.t - min(watch.since, state.t) >= watch.lasts
            if lasted and (found := watch.check(view, state, watch.limit.fraction)):
                return found
        return ""

    def opens_first(self, breach: Breach, mode: Mode | str) -> bool:
        """Return whether the hand opens before this fault takes its torque."""
        commanded = self._limits.frame_age_action == "open"
        return commanded and breach.name == "tactile.silent" and mode in GRIPPING

    # Goals

    def write(self, servos: Servos, state: State) -> None:
        """Bound the state's goal in place and send it; a non-finite one is invalid, and not sent.

        Raises ServoError as `Servos.write` does.
        """
        goal = state.goal
        q, current = goal.q, goal.current
        present = state.reading.q
        if state.seq - self._sent_seq != 1:  # torque was off: from the present angle, no current
            self._sent_q[:] = present
            self._sent_current[:] = (0.0, 0.0)
        self._sent_seq = state.seq
        for i, low, high in self._ends:
            self._bound_one(goal, i, low, high, present[i])
            if not goal.valid:
                return
            self._sent_q[i] = q[i]
            self._sent_current[i] = current[i]
        if goal.valid:
            servos.write(goal)

    def _bound_one(self, goal: Goal, i: int, low: float, high: float, present: float) -> None:
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
        # The joint's limits have the last word.
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
