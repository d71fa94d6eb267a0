"""The last stage before the servos: judges every state, bounds every goal, and sends it.

`Safety.write` is the only way from a goal to the bus, and bounds what it sends. `Safety.judge` is
asked at every tick. What is judged stands in one table, `safety.limits.ROWS`; here stands when, and
how a warning is told once and a fault is found.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from softfinger.daemon.control.modes import GRIPPING, Mode
from softfinger.daemon.perception.contact_filter import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.limit_checks import PAST_STOP, View, reading_age
from softfinger.daemon.safety.limits import ROWS, Row
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.types import Goal, State

_AGAIN = 1.0  # s after which a warning that was over may be told again
_EASE = 0.95  # of a bound: what was told stands until it is below

BUS = "servos.bus"  # the row of what the servo backend itself refuses
TORQUE_OFF = "torque.off"  # the row of torque off that is not confirmed, `safety.torque_state`


class Finding(NamedTuple):
    """A fault that stands: its row's name, and what was found."""

    name: str
    text: str


class _Watch:
    """One row, and since when it stands."""

    __slots__ = ("check", "ended", "lasts", "row", "since", "told")

    def __init__(self, row: Row, settings: Settings) -> None:
        assert row.check is not None
        self.row = row
        self.check = row.check
        lasts = getattr(settings.safety, row.lasts) if isinstance(row.lasts, str) else row.lasts
        self.lasts = float(lasts)
        self.since = math.inf  # it stands since then, inf: it does not
        self.ended = -math.inf
        self.told = False

    def look(self, view: View, state: State) -> str:
        """What stands now and for long enough, or an empty text."""
        row = self.row
        found = self.check(view, state, row.share * _EASE if self.told else row.share)
        if not found:
            if self.since < math.inf:
                self.since = math.inf
                self.ended = state.t
            if self.told and state.t - self.ended > _AGAIN:
                self.told = False
            return ""
        self.since = min(self.since, state.t)
        return found if state.t - self.since >= self.lasts else ""


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
        self._view = View(settings, grasp, sensors)
        self._limits = settings.safety
        self._has_sensors = has_sensors
        self._fingers = self._view.fingers
        there = {"": True, "servos": has_servos, "sensors": has_sensors}
        rows = [row for row in ROWS if row.check is not None and there[row.needs]]
        watches = [_Watch(row, settings) for row in rows]
        self._each_tick = [watch for watch in watches if watch.row.at_once]
        self._in_turn = [watch for watch in watches if not watch.row.at_once]
        # In the table's order: the first one that stands is the fault's name.
        self._faults = [watch for watch in watches if watch.row.level == "fault"]
        self._turn = 0
        self._busy = False  # a row that is judged at every tick stands, or did a moment ago
        self._found: dict[_Watch, str] = {}  # faults that stand
        self.warnings: list[Finding] = []  # to be told; the loop empties it
        self.limited: Counter[str] = Counter()  # ticks in which a goal was changed, by row
        self._prepare(settings, has_servos)

    def _prepare(self, settings: Settings, has_servos: bool) -> None:
        limits, hand = settings.safety, settings.hand
        self._age = reading_age(self._view) if has_servos else math.inf
        near = min((row.share for row in ROWS if row.name.startswith("tip.")), default=1.0)
        self._joints = [
            (i, hand.q_min[i] - PAST_STOP, hand.q_max[i] + PAST_STOP) for i in self._fingers
        ]
        if not has_servos:
            self._joints = []
        self._velocity, self._current = limits.velocity_max, limits.current_fault
        self._force, self._d = near * limits.force_max, near * limits.d_max
        self._tilt = (near, near * limits.theta_margin, near / settings.tip.radius)
        self._frame_age = limits.frame_age_fault * self._view.frame_period
        self._hold_age = limits.frame_age_hold * self._view.frame_period
        dt = 1.0 / settings.loop.rate
        self._step = limits.goal_speed * dt
        # In position mode no current bounds what a jump does.
        self._reach = 0.0 if settings.servos.mode == "position" else limits.goal_reach
        self._rise = limits.current_rate * dt
        self._ends = [(i, hand.q_min[i], hand.q_max[i]) for i in self._fingers]
        self._sent_q = [0.0, 0.0]
        self._sent_current = [0.0, 0.0]
        self._sent_seq = -2

    # Judging

    def judge(self, state: State) -> Finding | None:
        """Look at this tick's state; the first fault that stands, if any.

        Warnings that are new are added to ``warnings``.
        """
        if self._joints:
            self._view.motion.follow(state.t, state.reading)
        if self._busy or not self._quiet(state):
            self._busy = False
            for watch in self._each_tick:
                self._look(watch, state)
                self._busy = self._busy or watch.told or watch.since < math.inf
            self._view.no_number = False
        self._turn = (self._turn + 1) % len(self._in_turn) if self._in_turn else 0
        if self._in_turn:
            self._look(self._in_turn[self._turn], state)
        if not self._found:
            return None
        gripping = state.mode in GRIPPING
        for watch in self._faults:
            if watch in self._found and (gripping or not watch.row.gripping):
                return Finding(watch.row.name, self._found[watch])
        return None

    def _look(self, watch: _Watch, state: State) -> None:
        found = watch.look(self._view, state)
        if watch.row.level == "fault":
            if found:
                self._found[watch] = found
            else:
                self._found.pop(watch, None)
        elif found and not watch.told:
            watch.told = True
            self.warnings.append(Finding(watch.row.name, found))

    def _quiet(self, state: State) -> bool:
        """Nothing that is judged at every tick can stand: one pass of comparisons.

        It may be False too often and never True too often. A number that is none compares false.
        """
        t, reading = state.t, state.reading
        if self._joints:
            if not t - reading.t <= self._age:
                return False
            if reading.alert or reading.lost or reading.frozen or self._view.motion.jumped:
                return False
            q, dq, current = reading.q, reading.dq, reading.current
            velocity, most = self._velocity, self._current
            for i, low, high in self._joints:
                if not (
                    low <= q[i] <= high
                    and -velocity <= dq[i] <= velocity
                    and -most <= current[i] <= most
                ):
                    return False
        if self._has_sensors:
            contacts = state.contacts
            oldest = t - self._frame_age
            near, margin, slope = self._tilt
            for i in self._fingers:
                contact = contacts[i]
                if not contact.t_sound >= oldest:
                    return False
                if contact.contact:
                    d = contact.d
                    # asin(x) ≥ x for x ≤ 1, so that this is inside near·(asin(1 − d/a) − margin)
                    if not (
                        contact.force <= self._force
                        and 0.0 <= d <= self._d
                        and abs(contact.theta) <= near - slope * d - margin
                        and contact.inside
                    ):
                        return False
        late = state.timing.late_in_row
        return late < self._limits.overruns_fault and not self._view.no_number

    def cause(self, state: State, gripping: bool = False) -> str:
        """The first fault that stands in this state, or an empty text: what refuses a command.

        With ``gripping`` the rows of a grip are judged, whatever the mode.
        """
        gripping = gripping or state.mode in GRIPPING
        for watch in self._faults:
            if watch.row.gripping and not gripping:
                continue
            found = watch.look(self._view, state)
            if found:
                return found
        return ""

    def must_hold(self, state: State) -> bool:
        """Frames are late: nothing is moved on until one comes or a fault latches."""
        if not self._has_sensors:
            return False
        oldest = state.t - self._hold_age
        contacts = state.contacts
        for index in self._fingers:
            if contacts[index].t_sound < oldest and state.mode in GRIPPING:
                self.limited["tactile.late"] += 1
                return True
        return False

    def opens_first(self, finding: Finding, mode: Mode | str) -> bool:
        """The hand shall open before this fault takes its torque."""
        wanted = self._limits.frame_age_action == "open"
        return wanted and finding.name == "tactile.silent" and mode in GRIPPING

    # Goals

    def write(self, servos: Servos, state: State) -> None:
        """Bound the state's goal and send it; a goal that is no number is not sent.

        Raises ServoError as `Servos.write` does.
        """
        self.bound(state)
        if state.goal.valid:
            servos.write(state.goal)

    def bound(self, state: State) -> None:
        """Bound the goal in place; a goal that is not a number becomes invalid."""
        goal = state.goal
        q, current = goal.q, goal.current
        present = state.reading.q
        if state.seq - self._sent_seq != 1:  # torque was off: from the present angle, no current
            self._sent_q[:] = present
            self._sent_current[:] = (0.0, 0.0)
        self._sent_seq = state.seq
        sent, reach, most = self._sent_current, self._reach, self._limits.current_max
        for i, low, high in self._ends:
            wanted = current[i]
            if (
                not (low <= q[i] <= high and -reach <= q[i] - present[i] <= reach)
                or not 0.0 <= wanted <= most
                or wanted > sent[i] + self._rise
            ):
                self._bound_one(goal, i, low, high, present[i])
                if not goal.valid:
                    return
            self._sent_q[i] = q[i]
            sent[i] = current[i]

    def _bound_one(self, goal: Goal, i: int, low: float, high: float, present: float) -> None:
        q, current = goal.q[i], goal.current[i]
        if not (math.isfinite(q) and math.isfinite(current)):
            goal.valid = False
            self._view.no_number = True
            return
        inside = min(max(q, low), high)
        if inside != q:
            self._count("goal.angle")
        sent = self._sent_q[i]
        lowest = min(sent, present - self._reach) - self._step
        highest = max(sent, present + self._reach) + self._step
        near = min(max(inside, lowest), highest)
        if near != inside:
            self._count("goal.step")
        # The joint's limits have the last word.
        goal.q[i] = min(max(near, low), high)
        most = min(max(current, 0.0), self._limits.current_max)
        if most != current:
            self._count("goal.current")
        slow = min(most, self._sent_current[i] + self._rise)
        if slow != most:
            self._count("goal.slew")
        goal.current[i] = slow

    def _count(self, name: str) -> None:
        self.limited[name] += 1
