"""Define the ``LIMITS`` table with the check and the consequence of each limit.

- ``warn``: a warning is sent on ``hand/event``. The warning is repeated only after the violation
  has been absent for a second.
- ``limit``: the goal is modified before it is sent; ``status`` counts the affected ticks.
- ``fault``: torque is turned off until ``clear``. ``clear`` is refused while the cause persists.

Each row decorates its check function, so the rows are in the order of this file. If several fault
limits are violated, the first row in the table determines the reported fault. ``softfinger limits``
prints the table with a profile's values. The limit name is used as ``kind`` in events and as
``fault_name`` in ``hand/state``. `safety.safety` defines when each row is checked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from softfinger.daemon.control.modes import GRIPPING_MODES, HOLDING_MODES, Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.wiring import WiringWatch
from softfinger.daemon.servos.control_table import VOLTAGE_UNIT, by_name, hardware_error_names
from softfinger.daemon.types import FINGERS, Contact, Reading, State
from softfinger.kinematics.hand.geometry import tip_position

_NOISE_RATIO = 1.5  # messages mention noise above this multiple of ``tactile.noise``
_WARNING_FRACTION = 0.9  # fraction of a fault limit above which a warning is issued
# Minimum ratio of current to position error [A/rad]. The position loops of all servos exceed this
# ratio.
_CURRENT_PER_ERROR = 2.0
_STANDSTILL_SPEED = 0.05  # speed below which a joint counts as stationary [rad/s]
# Smallest relative increase in commanded force that is checked. The tips must measure at least this
# fraction of the increase.
_FORCE_RISE_MIN = 0.2
_RESPONSE_TIME = 0.3  # minimum time for the measured force to respond to an increase [s]
_STEP_TOLERANCE = 0.02  # tolerance added to the largest step possible at maximum velocity [rad]
_DRIFT_MAX = 0.1  # allowed difference between the angle and the integrated velocity [rad]
_DRIFT_TIME = 0.1  # time window of the drift check [s]; the window allows for velocity lag
# The drift window restarts if the interval between readings exceeds both this time [s] and three
# ticks.
_LATE_TIME = 0.02
_FAILURE_TIME = 0.72  # time constant for averaging the fraction of failed readings [s]
_FAILED_FRACTION_MAX = 0.75  # maximum fraction of failed readings, reached after 1 s of failures
_GAP_TIME = 0.1  # interval between readings above which position steps are not checked [s]


class JointMotion:
    """Check of joint angles against the measured velocities and the maximum velocity.

    An encoder may jump, freeze while the joint rotates, or drift while the joint is stationary. The
    angles of a faulty encoder are inconsistent with the measured velocity. If an encoder is faulty,
    the bit of its finger is set in ``jumped``.
    """

    def __init__(self, fingers: Sequence[int], velocity_max: float, period: float) -> None:
        """Create the check; ``period`` is the duration of a tick [s]."""
        self.jumped = 0
        self._fingers = tuple(fingers)
        self._velocity_max = velocity_max
        self._late_time = max(_LATE_TIME, 3.0 * period)
        self._gap_time = max(_GAP_TIME, self._late_time)
        self._request_time = -math.inf  # request time of the last valid reading [s]
        self._t = -math.inf  # time of the last valid reading [s]
        self._q = [0.0, 0.0]
        self._drift = [0.0, 0.0]  # angle minus integrated velocity [rad]

    def restart(self) -> None:
        """Discard all readings. The next reading is not compared with an earlier reading."""
        self.jumped = 0
        self._request_time = self._t = -math.inf

    def update(self, requested: float, reading: Reading) -> None:
        """Check a reading that was requested at time ``requested``."""
        self.jumped = 0
        t = reading.t
        if not reading.valid or t == self._t:
            return
        # Each reading is measured at an unknown time between the request and the reply.
        longest, dt = t - self._request_time, t - self._t
        q, before, apart = reading.q, self._q, self._drift
        if longest < self._gap_time:
            limit = self._velocity_max * longest + _STEP_TOLERANCE
            keep = max(1.0 - dt / _DRIFT_TIME, 0.0) if longest < self._late_time else 0.0
            for i in self._fingers:
                step = q[i] - before[i]
                before[i] = q[i]
                off = apart[i] = keep * (apart[i] + step - reading.dq[i] * dt)
                if not (-limit <= step <= limit and -_DRIFT_MAX <= off <= _DRIFT_MAX):
                    self.jumped |= 1 << i
                    apart[i] = 0.0
        else:
            before[:] = q
            apart[:] = 0.0, 0.0
        self._t, self._request_time = t, requested


class View:
    """Data for the checks: settings, grasp, sensors, and a history of earlier states."""

    def __init__(
        self,
        settings: Settings,
        grasp: GraspState,
        sensors: Sequence[FingerPerception],
    ) -> None:
        self.settings = settings
        self.limits = settings.safety
        self.fingers = settings.scene.indices
        self.grasp = grasp
        self.sensors = sensors
        self.wiring = WiringWatch(self.fingers)
        self.failed = 0.0  # fraction of failed readings in about the last second
        self._t = math.nan  # time of the previous state [s]
        self.motion = JointMotion(self.fingers, self.limits.velocity_max, 1.0 / settings.loop.rate)
        self._torque = False  # True if torque was on when the latest reading was requested
        servos = settings.servos  # In current mode, the stiffness limits `pull`.
        self.pull = _CURRENT_PER_ERROR
        if servos.mode == "current":
            self.pull = min(self.pull, 0.5 * servos.stiffness)
        self.bad_goal = False  # True if a goal was not finite since the previous check
        self.grip_width = math.nan  # object width at the start of the grip [m]
        self._target = math.nan  # commanded grip force on the previous tick [N]
        self.rise_t = math.inf  # time of a commanded force increase that is not yet measured [s]
        self.rise_felt = 0.0  # measured force at `rise_t` [N]
        # Time within which the measured force must respond to an increase [s]. It is at least the
        # time in which the setpoint reaches its target (see `control.setpoint.Setpoint`).
        control = settings.control
        ramp_time = control.force_time + 1.5 * control.smooth_time
        self.response_time = max(_RESPONSE_TIME, ramp_time)
        model = by_name(servos.model)
        self.voltage = (
            self.limits.voltage_min or model.voltage_min * VOLTAGE_UNIT,
            self.limits.voltage_max or model.voltage_max * VOLTAGE_UNIT,
        )

    def update(self, state: State) -> None:
        """Update the history with the state of the current tick."""
        # A jump is a fault only while torque is on. Without torque, the clock of an emulated hand
        # does not wait for the daemon. The emulated joints may then move further than the time
        # between two readings allows, so the readings are not compared.
        if self._torque:
            self.motion.update(state.t, state.reading)
        else:
            self.motion.restart()
        self._torque = state.torque
        self.wiring.update(state)
        passed, self._t = state.t - self._t, state.t
        if passed > 0.0:
            weight = min(passed / _FAILURE_TIME, 1.0)
            self.failed += weight * ((not state.reading.valid) - self.failed)
        if not self.holds(state):
            self.grip_width = math.nan
        elif math.isnan(self.grip_width):
            self.grip_width = state.object.width
        self._follow_force(state)

    def _follow_force(self, state: State) -> None:
        target, last = state.goal.force, self._target
        self._target = target
        contacts = [state.contacts[i] for i in self.fingers]
        felt = sum(contact.force for contact in contacts) / len(contacts)
        in_grip = state.mode in GRIPPING_MODES and all(map(_touches, contacts))
        if not (in_grip and target > felt):
            self.rise_t = math.inf
        elif target > (1.0 + _FORCE_RISE_MIN) * last and self.rise_t == math.inf:
            self.rise_t, self.rise_felt = state.t, felt
        elif abs(felt - self.rise_felt) > _FORCE_RISE_MIN * (target - self.rise_felt):
            self.rise_t = math.inf

    def touched(self, state: State) -> bool:
        """Return True if both tips have valid contacts and the object pose is valid."""
        left, right = state.contacts
        return state.object.valid and _touches(left) and _touches(right)

    def holds(self, state: State) -> bool:
        """Return True if the grip has settled and `touched` is true."""
        return state.mode in HOLDING_MODES and self.touched(state)


def _touches(contact: Contact) -> bool:
    return contact.valid and contact.contact


# The float argument of a check is the fraction of the bound at which a violation is reported. A
# check returns a description of the violation, or "" if the state is within the bound. Checks do
# not modify the state. NaN violates every bound.
Check = Callable[[View, State, float], str]
FingerCheck = Callable[..., str]  # the arguments of a check and the index of a finger


@dataclass(frozen=True, slots=True)
class Limit:
    """One row of the limit table. As a decorator, `Limit` adds the row with the decorated check.

    A row without a check is appended to `LIMITS` directly. A limit without a check is applied in
    `Safety.write`, on the bus or in the gateway.
    """

    name: str
    quantity: str
    level: Literal["warn", "limit", "fault"]
    keys: tuple[str, ...] = ()  # settings that define the limit
    needs: Literal["", "servos", "sensors"] = ""
    check: Check | None = None
    lasts: float | str = 0.0  # minimum duration of a violation [s], or the setting that contains it
    fraction: float = 1.0  # fraction of the bound at which a violation is reported
    warn_at: float = 0.0  # fraction of the bound at which a fault limit also warns; 0 for never
    in_turn: bool = False  # True if the check takes turns with others, one check per tick
    gripping: bool = False  # True if the limit applies only while gripping

    def __call__(self, check: Check) -> Check:
        """Add the row with its check to `LIMITS`, after a row for the warning, if there is one."""
        if self.warn_at:
            LIMITS.append(replace(self, check=check, level="warn", fraction=self.warn_at))
        LIMITS.append(replace(self, check=check))
        return check

    def each(self, check: FingerCheck) -> FingerCheck:
        """Add the row with a check that runs for each finger and reports the first violation."""

        def judge(view: View, state: State, fraction: float) -> str:
            for i in view.fingers:
                if found := check(view, state, fraction, i):
                    return found
            return ""

        self(judge)
        return check

    def sides(self, check: FingerCheck) -> FingerCheck:
        """Add one row for each finger, whose name replaces ``{side}`` in the name of the row."""
        for i, side in enumerate(FINGERS):
            replace(self, name=self.name.format(side=side))(partial(check, i=i))
        return check


LIMITS: list[Limit] = []


# --- servos ---------------------------------------------------------------------------------------

LIMITS.append(Limit("servos.bus", "lost port, servo stopped by its watchdog, or rejected goals",
    "fault", ("servos.watchdog",)))  # fmt: skip


@Limit("servos.silent", "age of the last valid servo reading; error replies do not count", "fault",
    ("servos.fault_after",), "servos")  # fmt: skip
def _servos_silent(view: View, state: State, _: float) -> str:
    age = state.t - state.reading.t
    if age <= view.settings.servos.fault_after:
        return ""
    return f"servos: no valid reading {_lasted(age)}"


def _lasted(age: float) -> str:
    return "yet" if age == math.inf else f"for {age:.3f} s"


@Limit("servos.silent",
    "fraction of servo readings that failed in the last second, whether torque is on or off",
    "warn", ("servos.reply_timeout",), "servos")  # fmt: skip
def _servos_late(view: View, _: State, fraction: float) -> str:
    if view.failed <= fraction * _FAILED_FRACTION_MAX:
        return ""
    allowed = 1e3 * view.settings.servos.reply_timeout
    return (
        f"servos: {view.failed:.0%} of the readings in the last second failed: no valid reply "
        f"within servos.reply_timeout = {allowed:g} ms; run `softfinger doctor` to measure the "
        "reply times"
    )


@Limit("servos.frozen",
    "servo whose clock register has not changed for 0.1 s, so its readings are outdated", "fault",
    needs="servos")  # fmt: skip
def _servos_frozen(view: View, state: State, _: float) -> str:
    frozen = state.reading.frozen
    if not frozen:
        return ""
    return (
        f"servos: outdated readings from the {_names(view, frozen)} servo: the clock register has "
        "stopped; check the cable, and switch the power supply off and on again"
    )


def _names(view: View, bits: int) -> str:
    return " and ".join(FINGERS[i] for i in view.fingers if bits >> i & 1)


@Limit("servos.alert", "hardware error reported by a servo", "fault", needs="servos")
def _servos_alert(view: View, state: State, _: float) -> str:
    reading = state.reading
    if not reading.alert:
        return ""
    parts = []
    for i in view.fingers:
        if reading.alert >> i & 1:
            what = hardware_error_names(reading.hardware[i]) if reading.hardware[i] else ""
            parts.append(f"{FINGERS[i]} ({what})" if what else FINGERS[i])
    return f"servos: hardware error reported by {' and '.join(parts)}"


@Limit("servos.heat", "predicted time until a servo reaches its temperature limit", "warn",
    ("safety.heat_warn", "safety.heat_action"), "servos", in_turn=True).each  # fmt: skip
def _servos_warm(view: View, state: State, fraction: float, i: int) -> str:
    left = state.heat[i].time_to_limit
    if left >= view.limits.heat_warn / fraction:
        return ""
    return f"the {FINGERS[i]} servo will reach {view.limits.temperature_max:g} °C in {left:.0f} s"


@Limit("servos.temperature", "temperature of a servo", "fault", ("safety.temperature_max",),
    "servos", in_turn=True).each  # fmt: skip
def _servos_hot(view: View, state: State, fraction: float, i: int) -> str:
    temperature = state.reading.temperature[i]
    bound = fraction * view.limits.temperature_max
    if temperature < bound:
        return ""
    return f"the {FINGERS[i]} servo is at {temperature:.0f} °C, expected below {bound:g} °C"


@Limit("servos.voltage", "supply voltage of a servo", "fault",
    ("safety.voltage_min", "safety.voltage_max"), "servos", in_turn=True,
    lasts=0.1).each  # fmt: skip
def _servos_voltage(view: View, state: State, _: float, i: int) -> str:
    (low, high), voltage = view.voltage, state.reading.voltage[i]
    if not voltage or low <= voltage <= high:
        return ""
    return (
        f"the supply voltage of the {FINGERS[i]} servo is {voltage:.1f} V, expected {low:.1f} to "
        f"{high:.1f} V"
    )


# --- joints ---------------------------------------------------------------------------------------

_STOP_TOLERANCE = 0.1  # tolerance for joints pushed beyond their limits [rad]


@Limit("joint.angle", "joint angle more than 0.1 rad beyond its limits", "fault",
    ("hand.q_min", "hand.q_max"), "servos").each  # fmt: skip
def _joint_angle(view: View, state: State, _: float, i: int) -> str:
    hand, q = view.settings.hand, state.reading.q[i]
    low, high = hand.q_min[i], hand.q_max[i]
    if low - _STOP_TOLERANCE <= q <= high + _STOP_TOLERANCE:
        return ""
    return f"the {FINGERS[i]} joint is at {q:.3f} rad, expected {low:g} to {high:g} rad"


@Limit("joint.velocity", "joint velocity", "fault", ("safety.velocity_max",), "servos").each
def _joint_velocity(view: View, state: State, _: float, i: int) -> str:
    bound, dq = view.limits.velocity_max, state.reading.dq[i]
    if -bound <= dq <= bound:
        return ""
    return f"the {FINGERS[i]} joint is moving at {dq:.2f} rad/s, above {bound:g} rad/s"


@Limit("joint.jump", "joint angle that deviates from the integrated velocity by 0.1 rad within "
    "0.1 s, or that changes faster than the maximum velocity", "fault", ("safety.velocity_max",),
    "servos")  # fmt: skip
def _joint_jump(view: View, _: State, __: float) -> str:
    if not view.motion.jumped:
        return ""
    return (
        f"the angle of the {_names(view, view.motion.jumped)} joint does not follow the joint's "
        "velocity: check for a slipping encoder or coupling"
    )


_POSITION_ERROR_MIN = 0.05  # position error above which a current is expected [rad]
_EXPECTED_CURRENT_MIN = 0.04  # expected current above which the current is checked [A]
_CURRENT_FRACTION_MIN = 0.25  # minimum measured current as a fraction of the expected current


@Limit("joint.dead", "joint that is at least 0.05 rad from its goal, but neither moves nor draws "
    "current for 0.05 s", "fault", needs="servos", in_turn=True, lasts=0.05).each  # fmt: skip
def _joint_dead(view: View, state: State, _: float, i: int) -> str:
    """Report a joint that is away from its goal, but neither moves nor draws current.

    A joint that is blocked by a load draws current. In position mode, the expected current is
    unknown, so the check is skipped.
    """
    goal, reading = state.goal, state.reading
    if not (state.torque and goal.valid) or view.settings.servos.mode == "position":
        return ""
    error = goal.q[i] - reading.q[i]
    if abs(error) < _POSITION_ERROR_MIN or abs(reading.dq[i]) > _STANDSTILL_SPEED:
        return ""
    expected = min(goal.current[i], view.pull * abs(error))
    toward = math.copysign(1.0, error) * reading.current[i]
    if not (expected > _EXPECTED_CURRENT_MIN and toward < _CURRENT_FRACTION_MIN * expected):
        return ""
    return (
        f"the {FINGERS[i]} joint is stationary {math.degrees(abs(error)):.1f}° from its goal and "
        f"draws only {toward:.2f} A (maximum {goal.current[i]:.2f} A): check the encoder, the "
        "current sensor and the motor"
    )


@Limit("joint.current", "measured current", "fault", ("safety.current_fault",), "servos",
    lasts=0.1).each  # fmt: skip
def _joint_current(view: View, state: State, _: float, i: int) -> str:
    bound, current = view.limits.current_fault, state.reading.current[i]
    well = -bound <= current <= bound
    return "" if well else f"the {FINGERS[i]} joint draws {current:.2f} A, more than {bound:g} A"


_FULL_CURRENT = 0.9  # minimum fraction of the goal's current limit that counts as saturation


@Limit("joint.stall", "joint that stalls at maximum current before it reaches its goal",
    "fault", ("safety.stall_error", "safety.stall_time"), "servos", in_turn=True,
    lasts="stall_time").each  # fmt: skip
def _joint_stall(view: View, state: State, _: float, i: int) -> str:
    if not state.torque or not state.goal.valid or state.mode in GRIPPING_MODES:
        return ""
    reading, goal = state.reading, state.goal
    by_current = view.settings.servos.mode != "position"
    error, current = abs(goal.q[i] - reading.q[i]), abs(reading.current[i])
    full = _FULL_CURRENT * (goal.current[i] if by_current else view.limits.current_max)
    stands = current >= full and abs(reading.dq[i]) < _STANDSTILL_SPEED
    if not (stands and error > view.limits.stall_error):
        return ""
    off = f"{math.degrees(error):.1f}° from its goal"
    return f"the {FINGERS[i]} joint has stalled {off} at {current:.2f} A"


@Limit("joint.swapped", "joint that moves the other finger's tip, or object that rotates in the "
    "opposite direction to the command", "fault", ("servos.ids",), "sensors")  # fmt: skip
def _joint_swapped(view: View, _: State, __: float) -> str:
    return view.wiring.swapped


@Limit("joint.blocked", "joint that stops for 0.5 s at maximum current during the "
    "approach although its tip has no contact", "warn",
    ("control.approach_current", "servos.direction"), "servos",
    lasts=0.5).each  # fmt: skip
def _joint_blocked(view: View, state: State, _: float, i: int) -> str:
    goal, reading, contact = state.goal, state.reading, state.contacts[i]
    if state.mode != Mode.GRASPING or not goal.valid or not view.sensors or contact.contact:
        return ""
    full = reading.current[i] >= _FULL_CURRENT * goal.current[i] > 0.0
    stands = (
        abs(reading.dq[i]) < _STANDSTILL_SPEED and goal.q[i] - reading.q[i] > _POSITION_ERROR_MIN
    )
    if not (full and stands):
        return ""
    return (
        f"the {FINGERS[i]} joint has stopped at {math.degrees(reading.q[i]):.0f}° during the "
        "approach although its tip has no contact: remove the obstacle; if joint friction stops "
        "the finger, run `softfinger calibrate friction` and increase control.approach_current; "
        "if the finger opens instead of closing, correct servos.direction"
    )


# Smallest reported overlap of the tips, in tip radii. Offset errors and frame latency cause smaller
# overlaps.
_OVERLAP_RATIO = 0.5


@Limit("joint.opens",
    "approach in which the joint angles imply that the tips overlap, but one tip has no contact",
    "warn", ("servos.direction",), "servos", in_turn=True)  # fmt: skip
def _joint_opens(view: View, state: State, _: float) -> str:
    """Report fingers that open instead of closing.

    If ``servos.direction`` is wrong, the goal, the angle and the current have the wrong sign. The
    servo readings of an opening finger are then the same as those of a closing finger. The error
    becomes visible only when the tips should meet but no contact is detected.
    """
    felt = [contact.contact for contact in state.contacts]
    if state.mode != Mode.GRASPING or len(view.sensors) < len(FINGERS) or all(felt):
        return ""
    hand, radius, q = view.settings.hand, view.settings.tip.radius, state.reading.q
    lengths = (0.5 * hand.pivot_separation, hand.finger_length, hand.finger_offset)
    (x1, y1), (x2, y2) = tip_position(q[0], 1.0, *lengths), tip_position(q[1], -1.0, *lengths)
    overlap = 2.0 * radius - math.hypot(x2 - x1, y2 - y1)
    if overlap < _OVERLAP_RATIO * radius:
        return ""
    tips = f"the {FINGERS[felt.index(False)]} tip has no" if any(felt) else "neither tip has"
    return (
        f"according to the joint angles, the tips overlap by {1e3 * overlap:.0f} mm, but {tips} "
        "contact: if a finger opens instead of closing, correct servos.direction; otherwise "
        "correct servos.zero"
    )


_CURRENT_FRACTION_MAX = 0.95  # minimum fraction of the maximum current that counts as saturation


@Limit("joint.strained", "joint that draws the maximum current in a grip", "warn",
    ("safety.current_max",), "servos", in_turn=True, lasts=1.0).each  # fmt: skip
def _joint_strained(view: View, state: State, fraction: float, i: int) -> str:
    limit = view.limits.current_max
    well = abs(state.reading.current[i]) < _CURRENT_FRACTION_MAX * fraction * limit
    if not state.torque or state.mode not in GRIPPING_MODES or well:
        return ""
    return (
        f"the {FINGERS[i]} joint requires the maximum current of {limit:g} A for this grip; reduce "
        "the force, or raise safety.current_max"
    )


LIMITS.append(Limit("torque.off", "the servos did not confirm within half of servos.watchdog that "
    "torque is off; the bus is then kept silent until the watchdogs stop the servos", "fault",
    ("servos.watchdog",)))  # fmt: skip


# --- goals ----------------------------------------------------------------------------------------


@Limit("goal.lost", "servo that has not received a goal for 0.05 s", "fault", (),
    "servos")  # fmt: skip
def _goal_lost(view: View, state: State, _: float) -> str:
    lost = state.reading.lost
    if not lost:
        return ""
    return f"servos: goals do not reach the {_names(view, lost)} servo: check the cable"


@Limit(
    "goal.number",
    "goal that is not a finite number and is therefore not sent",
    "fault",
    needs="servos",
)
def _goal_number(view: View, _: State, __: float) -> str:
    return "control: computed a goal that is not a finite number" if view.bad_goal else ""


LIMITS += [
    Limit("goal.angle", "goal angle", "limit", ("hand.q_min", "hand.q_max")),
    Limit("goal.current", "goal current", "limit", ("safety.current_max",)),
    Limit("goal.step", "goal angle step while the goal is far from the joint angle", "limit",
        ("safety.goal_reach", "safety.goal_speed")),
    Limit("goal.slew", "increase in goal current per tick", "limit", ("safety.current_rate",)),
]  # fmt: skip


# --- tips -----------------------------------------------------------------------------------------


# After a blow, the first frame shows the object at its farthest position. The object springs back
# before the next frame, so the estimated force is too high for one frame period (40 ms at 25 Hz).
@Limit("tip.force", "normal force of a tip", "fault", ("safety.force_max",), "sensors",
    lasts=0.05, warn_at=_WARNING_FRACTION).each  # fmt: skip
def _tip_force(view: View, state: State, fraction: float, i: int) -> str:
    bound, contact = fraction * view.limits.force_max, state.contacts[i]
    if not _touches(contact) or contact.force <= bound:
        return ""
    return f"the {FINGERS[i]} tip force is {contact.force:.1f} N, above {bound:g} N"


@Limit("tip.displacement", "displacement of a tip", "fault", ("safety.d_max",), "sensors",
    warn_at=_WARNING_FRACTION).each  # fmt: skip
def _tip_displacement(view: View, state: State, fraction: float, i: int) -> str:
    bound, contact = fraction * view.limits.d_max, state.contacts[i]
    if not _touches(contact) or contact.d <= bound:
        return ""
    d, largest = contact.d * 1e3, bound * 1e3
    return f"the {FINGERS[i]} tip displacement is {d:.2f} mm, above {largest:g} mm"


@Limit("tip.tilt", "|θ|; the limit is asin(1 − d/a) minus a margin", "fault",
    ("safety.theta_margin",), "sensors", warn_at=_WARNING_FRACTION).each  # fmt: skip
def _tip_tilt(view: View, state: State, fraction: float, i: int) -> str:
    """Check that |θ| ≤ fraction·(asin(1 − d/a) − margin).

    At a tilt of asin(1 − d/a), the object plane reaches the rim of the tip's backing plate. The
    check compares sines, because the sine is defined for every finite angle.
    """
    radius, margin = view.settings.tip.radius, view.limits.theta_margin
    contact = state.contacts[i]
    if not _touches(contact):
        return ""
    tilt = abs(contact.theta) / fraction + margin
    if contact.inside and tilt <= 1.57 and math.sin(tilt) <= 1.0 - contact.d / radius:
        return ""
    if not contact.inside and view.settings.tip.physics != "springs":
        tilt = math.degrees(math.hypot(contact.theta, contact.tilt_y))
        deep = f"the {FINGERS[i]} tip is compressed by {contact.d * 1e3:.2f} mm"
        return f"{deep} at a tilt of {tilt:.1f}°, outside the range of its contact model"
    limit = fraction * (math.asin(min(max(1.0 - contact.d / radius, 0.0), 1.0)) - margin)
    tilt, largest = math.degrees(contact.theta), math.degrees(limit)
    return (
        f"the {FINGERS[i]} tip tilt is {tilt:.1f}°, expected at most {largest:.1f}° at this depth"
    )


# --- sensors --------------------------------------------------------------------------------------

LIMITS.append(Limit("tactile.late",
    "age of the last valid frame; above this limit, the goal is frozen", "limit",
    ("safety.frame_age_hold",), "sensors", gripping=True))  # fmt: skip


@Limit("tactile.silent", "age of the last valid frame", "fault",
    ("safety.frame_age_fault", "safety.frame_age_action"), "sensors",
    gripping=True).each  # fmt: skip
def _tactile_silent(view: View, state: State, _: float, i: int) -> str:
    contact = state.contacts[i]
    age = state.t - contact.t_valid
    if age <= view.limits.frame_age_fault / view.settings.tactile.rate:
        return ""
    what = "frame" if contact.t_arrival == contact.t_valid else "valid estimate"
    cure = ""
    for sensor in (each for each in view.sensors if each.finger == i):
        if sensor.sensor.counters().get("port_lost"):
            cure = ": the port is lost; send `clear`, or `disarm` and `arm`, to reopen it"
        elif what != "frame":
            cure = f": {sensor.estimate.invalid.text}" if sensor.estimate.invalid else ""
            noise = view.settings.tactile.noise
            if sensor.noise > _NOISE_RATIO * noise:
                cure += (
                    f"; the measured cell noise is {sensor.noise:.0f} Pa, expected tactile.noise "
                    f"= {noise:g} Pa"
                )
    return (
        _sensor_fault(view, state, i)
        or f"tactile: no {what} from the {FINGERS[i]} sensor {_lasted(age)}{cure}"
    )


def _sensor_fault(view: View, state: State, finger: int) -> str:
    """Describe the fault of a sensor; return "" if the sensor has no fault."""
    side, found = FINGERS[finger], view.grasp
    if found.rejects_frames[finger]:
        turned, deeper = found.angle_jump[finger], found.d_jump[finger]
        what = f"{math.degrees(abs(turned)):.0f}° in the object's angle"
        if abs(deeper) > abs(turned) * view.settings.tip.radius:
            what = f"{1e3 * deeper:+.1f} mm in d"
        return (
            f"the {side} sensor reports a jump of {what}, which is inconsistent with the joints "
            "and the other tip: the sensor has shifted, its frames are old, or the tip is at the "
            "object's edge"
        )
    if found.has_angle_bias[finger] and view.holds(state):
        return (
            f"the angle measured by the {side} sensor differs by "
            f"{math.degrees(found.angle_bias[finger]):+.0f}° from the rolling angle computed from "
            "the joints: the sensor's image has shifted"
        )
    if found.has_d_bias[finger] and view.holds(state):
        off = 1e3 * found.d_bias[finger]
        return (
            f"the displacement measured by the {side} sensor is {abs(off):.1f} mm "
            f"{'less' if off < 0.0 else 'more'} than the value computed from the joint's angle and "
            "torque: tare the sensor"
        )
    for sensor in view.sensors:
        if sensor.finger == finger and sensor.repeats.is_fault:
            return f"the {side} sensor repeats its last {sensor.repeats.period} frames"
    return ""


_GAIN_SIGMA = 1.5  # number of prior standard deviations above which a gain error is reported


def _gain_fault(view: View, finger: int) -> str:
    """Describe a sensor's implausible gain error; return "" if the gain is plausible."""
    grasp = view.grasp
    off, unsure = grasp.gain_change[finger], grasp.gain_std[finger]
    if not abs(off) - unsure > _GAIN_SIGMA * grasp.gain_prior_std[finger]:
        return ""
    return (
        f"the {FINGERS[finger]} sensor reads {math.exp(off):.0%} of the pressure expected from the "
        "joints and the other tip: tare or calibrate the sensor"
    )


@Limit("consistency.{side}_sensor",
    "difference between a tip's frames and the values expected from the joints and the other tip",
    "warn", ("tactile.gain_error",), "sensors", in_turn=True).sides  # fmt: skip
def _sensor(view: View, state: State, _: float, i: int) -> str:
    if i not in view.fingers:
        return ""
    # Check the gain only during a grip. After a release, the sensor cells may relax more slowly
    # than the tip.
    return _sensor_fault(view, state, i) or (_gain_fault(view, i) if view.holds(state) else "")


@Limit("consistency.{side}_current",
    "difference between the measured current and the goal current of a joint in a grip", "warn",
    (), "servos", in_turn=True).sides  # fmt: skip
def _current(view: View, state: State, _: float, i: int) -> str:
    if not view.grasp.has_wrong_current[i]:
        return ""
    return (
        f"the {FINGERS[i]} joint's measured current is {state.reading.current[i]:.2f} A, but its "
        f"goal current is {state.goal.current[i]:.2f} A, so the measured current is ignored"
    )


@Limit("consistency.force", "measured force that has not followed the commanded force for 0.3 s, "
    "or for the duration of the force ramp if the ramp takes longer", "fault",
    ("control.force_time", "control.smooth_time"), "sensors", in_turn=True)  # fmt: skip
def _force_response(view: View, state: State, _: float) -> str:
    if not state.t - view.rise_t > view.response_time:
        return ""
    return (
        f"the commanded force rose to {state.goal.force:.1f} N, but the measured force stayed at "
        f"{view.rise_felt:.1f} N"
    )


@Limit("tactile.frozen", "duration of identical frames during contact", "fault",
    ("safety.frozen_after",), "sensors", in_turn=True)  # fmt: skip
def _tactile_frozen(view: View, state: State, _: float) -> str:
    for sensor in view.sensors:
        same = 0.0 if sensor.frame is None else sensor.frame.t_arrival - sensor.changed_time
        if same > view.limits.frozen_after > 0.0 and state.contacts[sensor.finger].contact:
            side = FINGERS[sensor.finger]
            return f"tactile: the {side} sensor has sent the same frame for {same:.2f} s"
    return ""


@Limit("tactile.saturated", "fraction of saturated cells", "warn", ("safety.saturated",), "sensors",
    in_turn=True, lasts=0.1)  # fmt: skip
def _tactile_saturated(view: View, _: State, fraction: float) -> str:
    limit = fraction * view.limits.saturated
    for sensor in view.sensors:
        if sensor.frame is None:
            continue
        data = sensor.frame.data
        saturated = np.count_nonzero(data >= sensor.full_count) / data.size
        if saturated > limit:
            return (
                f"tactile: {saturated:.0%} of the cells of the {FINGERS[sensor.finger]} sensor "
                "are saturated"
            )
    return ""


@Limit("tactile.misfit", "frames that do not match the contact model", "warn",
    ("tactile.noise",), "sensors", in_turn=True, lasts=0.5).each  # fmt: skip
def _tactile_misfit(_: View, state: State, __: float, i: int) -> str:
    if not state.contacts[i].misfit:
        return ""
    return (
        f"tactile: the {FINGERS[i]} sensor's frames do not match the contact model, so d and theta "
        "may be biased: check the tip material, the cell gains and tactile.noise"
    )


# --- the hand and its grip ------------------------------------------------------------------------

_ANGLE_SIGMA = 4.0  # smallest significant difference between the angles, in standard deviations


@Limit("hand.angle", "difference between the two fingers' estimates of the object's angle", "fault",
    ("safety.residual_angle", "object.taper"), "sensors", in_turn=True, lasts=0.2,
    warn_at=0.5)  # fmt: skip
def _hand_angle(view: View, state: State, fraction: float) -> str:
    if not view.touched(state) or len(view.sensors) < 2:
        return ""
    # Compare the unfiltered estimates from the newest frames.
    left, right = (sensor.estimate for sensor in view.sensors)
    if not (left.contact and right.contact):
        return ""
    unsure = _ANGLE_SIGMA * (left.tilt_x_std + right.tilt_x_std)
    bound = max(fraction * view.limits.residual_angle, unsure)
    q = state.reading.q
    apart = (left.tilt_x - q[0]) - (right.tilt_x + q[1]) + view.settings.object.taper
    if abs(apart) <= bound:
        return ""
    return (
        "the two fingers' estimates of the object's angle differ by "
        f"{math.degrees(abs(apart)):.1f}°: check the joints' zeros (servos.zero and homing "
        "offsets), the object's taper (object.taper) and position, and each sensor's mounting, "
        "centre and rotation"
    )


@Limit("hand.width", "change in the held object's width since it was gripped", "fault",
    ("safety.residual_width",), "sensors", in_turn=True, lasts=0.2)  # fmt: skip
def _hand_width(view: View, state: State, fraction: float) -> str:
    changed = state.object.width - view.grip_width
    if not (view.holds(state) and abs(changed) > fraction * view.limits.residual_width):
        return ""
    return (
        f"the held object's width has changed by {changed * 1e3:+.1f} mm since it was gripped: a "
        "sensor or a joint's zero has shifted"
    )


@Limit("hand.force", "difference between the two tip forces", "warn", ("safety.residual_force",),
    "sensors", in_turn=True, lasts=0.3)  # fmt: skip
def _hand_force(view: View, state: State, fraction: float) -> str:
    left, right = (contact.force for contact in state.contacts)
    bound = fraction * view.limits.residual_force * max(left, right)
    if not view.holds(state) or abs(left - right) <= bound:
        return ""
    return f"the forces of the two tips differ: left {left:.1f} N, right {right:.1f} N"


@Limit("grip.slip", "ratio of shear to normal force; the limit is the friction coefficient "
    "minus a margin", "warn",
    ("control.tip_friction", "control.slip_margin"), "sensors", in_turn=True,
    lasts=0.1)  # fmt: skip
def _grip_slip(view: View, state: State, fraction: float) -> str:
    control, shear = view.settings.control, view.grasp.shear
    usable = control.tip_friction * (1.0 - control.slip_margin)
    if not view.holds(state) or shear <= fraction * usable:
        return ""
    return (
        f"the shear force is {shear:.2f} times the grip force, above the limit of {usable:.2f}: "
        "the object may slip"
    )


# --- commands and the loop ------------------------------------------------------------------------

LIMITS.append(Limit("commands.pace", "command rate of a client; `stop` is always accepted",
    "limit", ("commands.per_second",)))  # fmt: skip


@Limit("loop.overruns", "consecutive late ticks", "fault", ("safety.overruns_fault",))
def _loop_overruns(view: View, state: State, _: float) -> str:
    late = state.timing.late_in_row
    return "" if late < view.limits.overruns_fault else f"loop: {late} consecutive ticks were late"
