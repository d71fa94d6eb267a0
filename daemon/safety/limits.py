"""Every limit of the hand in one table, ``LIMITS``: what is judged, how, and what follows.

- ``warn``: reported once on ``hand/event``, again only after it has been over for a while.
- ``limit``: the goal is changed before it reaches the bus; ``status`` counts the ticks.
- ``fault``: torque off, latched until ``clear``, which is refused as long as the cause stands.

``softfinger limits`` prints the table with a profile's numbers. A limit's name is the ``kind`` of
its events and the ``fault_name`` of ``hand/state``. How the table is gone through at each tick
stands in `safety.safety`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, cast

import numpy as np

from softfinger.daemon.control.modes import GRIPPING, HELD
from softfinger.daemon.perception.contact_filter_kernels import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.joint_motion import JointMotion
from softfinger.daemon.servos.control_table import VOLTAGE_UNIT, by_name, hardware_error_names
from softfinger.daemon.types import FINGERS, State

_PAST_STOP = 0.1  # rad beyond a joint limit that a push may take a joint
_FULL_CURRENT = 0.9  # of a goal's bound: a joint that takes more has no reserve
_ALL = 0.95  # of the greatest current there may be: a grip that takes more can't be firmer
_SLOW = 0.05  # rad/s below which a joint stands
_OFF = 0.05  # rad off its goal from which on a joint must be pulled there …
_PULL = 2.0  # … with so much current [A/rad]: less than any model's own loop gives
_FELT = 0.04  # A that must be expected for that to be judged
_PULLED = 0.25  # of what is expected
_SURE = 4.0  # standard deviations of both tips' tilts that they must be apart
_NEAR = 0.9  # of a fault's bound: warned from there on


class View:
    """What the limits look at beside the state: the scene, and what a few of them remember."""

    def __init__(
        self,
        settings: Settings,
        grasp: GraspState | None = None,
        sensors: Sequence[FingerPerception] = (),
    ) -> None:
        self.settings = settings
        self.limits = settings.safety
        self.fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self.grasp = GraspState() if grasp is None else grasp
        self.sensors = sensors
        self.motion = JointMotion(self.fingers, self.limits.velocity_max, 1.0 / settings.loop.rate)
        servos = settings.servos  # in current mode the pull is the daemon's own
        self.pull = min(_PULL, 0.5 * servos.stiffness) if servos.mode == "current" else _PULL
        self.bad_goal = False  # a goal was not finite since the last judgement
        self.grip_width = math.nan  # of the object when it was gripped [m]
        low, high = settings.safety.voltage_min, settings.safety.voltage_max
        if settings.servos.backend != "none":
            model = by_name(settings.servos.model)
            low = low or model.voltage_min * VOLTAGE_UNIT
            high = high or model.voltage_max * VOLTAGE_UNIT
        self.voltage = (low, high)

    def touched(self, state: State) -> bool:
        """Both tips soundly touch an object of known angle and width."""
        left, right = state.contacts
        touch = left.valid and left.contact and right.valid and right.contact
        return state.object.valid and touch

    def holds(self, state: State) -> bool:
        """They do so in a grip that has settled."""
        return state.mode in HELD and self.touched(state)


Check = Callable[[View, State, float], str]  # the share of the bound; what stands, or an empty text
Text = Callable[[View, State, int, float], str]  # the finger, 0 if of the hand; and the share


@dataclass(frozen=True, slots=True)
class Limit:
    """One row. Without ``holds`` and ``check`` it is met elsewhere: in `Safety.write`, on the bus.

    ``holds`` is an expression of `checking`'s names, with numbers of the settings filled in:
    `safety.safety` joins those of every tick to one check. What takes more to compute is a
    ``check``.
    """

    name: str
    judged: str
    level: Literal["warn", "limit", "fault"]
    keys: tuple[str, ...] = ()
    needs: Literal["", "servos", "sensors"] = ""
    holds: str = ""  # while it is kept; with {i} it is one of each finger
    text: Text | None = None  # what is reported where it is not
    check: Check | None = None
    remember: Callable[[View, State], None] | None = None  # what the check compares with
    lasts: float | str = 0.0  # s that it must stand, or the setting that says so
    share: float = 1.0  # of the bound
    in_turn: bool = False  # one such ``holds`` or ``check`` is judged a tick; the others at each
    gripping: bool = False  # stands only while the hand grips

    def terms(self, view: View, share: str) -> dict[str, int]:
        """``holds`` of each finger it is about, in Python, with ``share`` of the bound."""
        settings = view.settings
        fingers = view.fingers if "{i}" in self.holds else [0] * bool(self.holds)
        sections = {name: getattr(settings, name) for name in type(settings).model_fields}
        return {
            self.holds.format(
                **sections,
                i=i,
                share=share,
                low=settings.hand.q_min[i] - _PAST_STOP,
                high=settings.hand.q_max[i] + _PAST_STOP,
                all=_ALL,
                friction=_usable(settings),
                frame_age=settings.safety.frame_age_fault / settings.tactile.rate,
            ): i
            for i in fingers
        }


def _usable(settings: Settings) -> float:
    """Share of the grip's force that shear may reach."""
    return settings.control.tip_friction * (1.0 - settings.control.slip_margin)


def checking(terms: Mapping[str, int], text: Text | None) -> Check:
    """A check by expressions of ``state, reading, contacts, view, share``, each of a finger.

    It reports the first that does not hold.
    """
    source = [
        "def check(view, state, share):",
        " reading, contacts = state.reading, state.contacts",
    ]
    source += [
        f" if not ({term}): return text(view, state, {i}, share)" for term, i in terms.items()
    ]
    return _compiled("\n".join([*source, ' return ""']), text)


@cache
def _compiled(source: str, text: Text | None) -> Check:
    names: dict[str, Any] = {"sin": math.sin, "GRIPPING": GRIPPING, "text": text}
    exec(source, names)
    return cast(Check, names["check"])


# --- texts of the limits that are judged at every tick --------------------------------------------


def _servos_silent(_: View, state: State, *__: float) -> str:
    age = state.t - state.reading.t
    lasted = "yet" if age == math.inf else f"for {age:.3f} s"
    return f"servos: no good reading {lasted}"


def _servo_alert(view: View, state: State, *_: float) -> str:
    reading, parts = state.reading, []
    for i in view.fingers:
        if reading.alert >> i & 1:
            what = hardware_error_names(reading.hardware[i]) if reading.hardware[i] else ""
            parts.append(f"{FINGERS[i]} ({what})" if what else FINGERS[i])
    return f"servos: hardware error reported by {' and '.join(parts)}"


def _named(view: View, bits: int) -> str:
    return " and ".join(FINGERS[i] for i in view.fingers if bits >> i & 1)


def _joint_jump(view: View, *_: object) -> str:
    return (
        f"{_named(view, view.motion.jumped)} joint's angle went where its velocity did not: its "
        "encoder, or what turns it, has slipped"
    )


def _hot(_: View, state: State, i: int, __: float) -> str:
    return f"{FINGERS[i]} servo at {state.reading.temperature[i]:.0f} °C"


def _tip_tilt(view: View, state: State, i: int, share: float) -> str:
    contact, radius = state.contacts[i], view.settings.tip.radius
    if not contact.inside and view.settings.tip.physics != "springs":
        tilt = math.degrees(math.hypot(contact.theta, contact.tilt_y))
        return f"{FINGERS[i]} tip {contact.d * 1e3:.2f} mm deep at {tilt:.1f}°: its law ends before"
    reach = math.asin(min(max(1.0 - contact.d / radius, 0.0), 1.0))
    limit = share * (reach - view.limits.theta_margin)
    return (
        f"{FINGERS[i]} tip at {math.degrees(contact.theta):.1f}°, "
        f"past {math.degrees(limit):.1f}° at this depth"
    )


def _tactile_silent(_: View, state: State, i: int, __: float) -> str:
    contact = state.contacts[i]
    what = "frame" if contact.t_arrival == contact.t_sound else "sound estimate"
    return f"tactile: no {what} for {state.t - contact.t_sound:.3f} s"


# --- checks of the limits that take turns ---------------------------------------------------------


def _joint_dead(view: View, state: State, _: float) -> str:
    """Off its goal it stands, and no current pulls it there. A joint that is held back takes some.

    In position mode nothing is known of the current that it should take.
    """
    goal, reading = state.goal, state.reading
    if not (state.torque and goal.valid) or view.settings.servos.mode == "position":
        return ""
    for i in view.fingers:
        error = goal.q[i] - reading.q[i]
        if abs(error) < _OFF or abs(reading.dq[i]) > _SLOW:
            continue
        expected = min(goal.current[i], view.pull * abs(error))
        toward = math.copysign(1.0, error) * reading.current[i]
        if expected > _FELT and toward < _PULLED * expected:
            return (
                f"{FINGERS[i]} joint stands {math.degrees(abs(error)):.1f}° off its goal and "
                f"takes {toward:.2f} A of {goal.current[i]:.2f} A to get there: encoder, "
                "current sensor or motor"
            )
    return ""


def _joint_stall(view: View, state: State, _: float) -> str:
    if not state.torque or not state.goal.valid or state.mode in GRIPPING:
        return ""
    reading, goal = state.reading, state.goal
    by_current = view.settings.servos.mode != "position"
    for i in view.fingers:
        error = goal.q[i] - reading.q[i]
        bound = goal.current[i] if by_current else view.limits.current_max
        if (
            abs(error) > view.limits.stall_error
            and abs(reading.current[i]) >= _FULL_CURRENT * bound
            and abs(reading.dq[i]) < _SLOW
        ):
            return (
                f"{FINGERS[i]} joint has stalled, {math.degrees(abs(error)):.1f}° off its goal "
                f"at {abs(reading.current[i]):.2f} A"
            )
    return ""


def _hand_angle(view: View, state: State, share: float) -> str:
    if not view.touched(state) or len(view.sensors) < 2:
        return ""
    left, right = (sensor.estimate for sensor in view.sensors)  # of the newest frames alone
    if not (left.contact and right.contact):
        return ""
    unsure = _SURE * (left.tilt_x_std + right.tilt_x_std)
    bound = max(share * view.limits.residual_angle, unsure)
    q = state.reading.q
    apart = (left.tilt_x - q[0]) - (right.tilt_x + q[1]) + view.settings.object.taper
    if abs(apart) <= bound:
        return ""
    return (
        f"the fingers see the object's angle {math.degrees(abs(apart)):.1f}° apart: the object "
        "lies askew between the tips or tapers (object.taper), a sensor has shifted, or its centre "
        "or rotation is wrong"
    )


def _remember_width(view: View, state: State) -> None:
    if not view.holds(state):
        view.grip_width = math.nan
    elif math.isnan(view.grip_width):
        view.grip_width = state.object.width


def _hand_width(view: View, state: State, share: float) -> str:
    changed = state.object.width - view.grip_width
    if not (view.holds(state) and abs(changed) > share * view.limits.residual_width):
        return ""
    return (
        f"the held object's width changed by {changed * 1e3:+.1f} mm since it was gripped: "
        "a sensor has shifted, or a joint's zero"
    )


def _hand_torque(view: View, state: State, share: float) -> str:
    if not view.holds(state):
        return ""
    control, grasp = view.settings.control, view.grasp
    for i in view.fingers:
        wanted = grasp.lever[i] * 0.5 * (state.contacts[0].force + state.contacts[1].force)
        found = control.torque_constant * state.reading.current[i]
        free = share * view.limits.residual_torque * abs(wanted) + 2.0 * control.joint_friction
        if abs(found - wanted) > free:
            return (
                f"{FINGERS[i]} joint gives {found:.2f} N·m, its tip feels what takes "
                f"{wanted:.2f} N·m"
            )
    return ""


def _frozen(view: View, state: State, _: float) -> str:
    for sensor in view.sensors:
        same = 0.0 if sensor.frame is None else sensor.frame.t_arrival - sensor.changed
        if same > view.limits.frozen_after > 0.0 and state.contacts[sensor.finger].contact:
            side = FINGERS[sensor.finger]
            return f"tactile: {side} sensor frozen, the same frame for {same:.2f} s"
    return ""


def _saturated(view: View, _: State, share: float) -> str:
    full, most = view.settings.tactile.full_count, share * view.limits.saturated
    for sensor in view.sensors:
        if sensor.frame is None:
            continue
        data = sensor.frame.data
        part = np.count_nonzero(data >= full) / data.size
        if part > most:
            return f"tactile: {part:.0%} of the {FINGERS[sensor.finger]} sensor's cells are full"
    return ""


# --- the table ------------------------------------------------------------------------------------

_S: Literal["servos"] = "servos"
_T: Literal["sensors"] = "sensors"
_FREE = "not (contacts[{i}].valid and contacts[{i}].contact) or "
_LEAN = "(abs(contacts[{i}].theta) / {share} + {safety.theta_margin})"


def _warn_and_fault(
    name: str, judged: str, key: str, holds: str, text: Text
) -> tuple[Limit, Limit]:
    """A limit of each tip, after the warning near it."""
    fault = Limit(name, judged, "fault", (key,), _T, _FREE + holds, text)
    return replace(fault, level="warn", share=_NEAR), fault


LIMITS: tuple[Limit, ...] = (
    Limit("servos.bus", "the port is there, the servos obey and were not stopped by their watchdog",
        "fault", ("servos.watchdog",)),
    Limit("servos.silent", "age of the last good servo reading; an error reply is not one",
        "fault", ("servos.fault_after",), _S,
        "state.t - reading.t <= {servos.fault_after}", _servos_silent),
    Limit("servos.frozen", "servo whose own clock stands still for 0.1 s: its readings are old",
        "fault", (), _S, "not reading.frozen", lambda view, state, *_:
        f"servos: old readings from {_named(view, state.reading.frozen)}: "
        "its own clock stands still"),
    Limit("servos.alert", "hardware error that a servo reports", "fault", (), _S,
        "not reading.alert", _servo_alert),
    Limit("servos.temperature", "temperature of a servo", "warn", ("safety.temperature_warn",), _S,
        "reading.temperature[{i}] < {share} * {safety.temperature_warn}", _hot, in_turn=True),
    Limit("servos.temperature", "temperature of a servo", "fault", ("safety.temperature_max",), _S,
        "reading.temperature[{i}] < {share} * {safety.temperature_max}", _hot, in_turn=True),
    Limit("servos.voltage", "supply of a servo", "fault",
        ("safety.voltage_min", "safety.voltage_max"), _S,
        "not reading.voltage[{i}] or view.voltage[0] <= reading.voltage[{i}] <= view.voltage[1]",
        lambda view, state, i, _:
        f"{FINGERS[i]} servo's supply at {state.reading.voltage[i]:.1f} V, "
        f"outside {view.voltage[0]:.1f} to {view.voltage[1]:.1f} V", in_turn=True, lasts=0.1),
    Limit("joint.angle", "joint angle, 0.1 rad past its limits", "fault",
        ("hand.q_min", "hand.q_max"), _S, "{low} <= reading.q[{i}] <= {high}",
        lambda _, state, i, __:
        f"{FINGERS[i]} joint at {state.reading.q[i]:.3f} rad, outside its limits"),
    Limit("joint.velocity", "joint velocity", "fault", ("safety.velocity_max",), _S,
        "-{safety.velocity_max} <= reading.dq[{i}] <= {safety.velocity_max}",
        lambda _, state, i, __: f"{FINGERS[i]} joint at {state.reading.dq[i]:.2f} rad/s, too fast"),
    Limit("joint.jump", "joint angle against its velocity, 0.1 rad within 0.1 s, and against the "
        "greatest velocity", "fault", ("safety.velocity_max",), _S,
        "not view.motion.jumped", _joint_jump),
    Limit("joint.dead", "joint that stands 0.05 rad off its goal without current for 0.05 s",
        "fault", (), _S, check=_joint_dead, lasts=0.05),
    Limit("joint.current", "measured current", "fault", ("safety.current_fault",), _S,
        "-{safety.current_fault} <= reading.current[{i}] <= {safety.current_fault}",
        lambda view, state, i, share: f"{FINGERS[i]} joint takes {state.reading.current[i]:.2f} A, "
        f"above {view.limits.current_fault:g} A", lasts=0.1),
    Limit("joint.stall", "current at its bound, off the goal, and standing", "fault",
        ("safety.stall_error", "safety.stall_time"), _S, check=_joint_stall, lasts="stall_time"),
    Limit("joint.strained", "grip that takes all the current there may be", "warn",
        ("safety.current_max",), _S, "not state.torque or state.mode not in GRIPPING or "
        "abs(reading.current[{i}]) < {all} * {share} * {safety.current_max}",
        lambda view, _, i, __:
        f"{FINGERS[i]} joint grips with all of its {view.limits.current_max:g} A",
        in_turn=True, lasts=1.0),
    Limit("torque.off", "torque off not confirmed within half the watchdog's time: the bus is kept "
        "silent until the watchdog stops the servos", "fault", ("servos.watchdog",)),
    Limit("goal.lost", "servo that for 0.05 s holds none of the goals sent to it", "fault", (), _S,
        "not reading.lost", lambda view, state, *_: "servos: none of the goals sent lately reached "
        f"{_named(view, state.reading.lost)}: check the cable"),
    Limit("goal.number", "non-finite goal: it is not sent", "fault", (), _S, "not view.bad_goal",
        lambda *_: "control: a non-finite goal"),
    Limit("goal.angle", "goal angle", "limit", ("hand.q_min", "hand.q_max")),
    Limit("goal.current", "goal current", "limit", ("safety.current_max",)),
    Limit("goal.step", "goal angle's step in a tick, where it is far from the joint", "limit",
        ("safety.goal_reach", "safety.goal_speed")),
    Limit("goal.slew", "goal current's rise in a tick", "limit", ("safety.current_rate",)),
    *_warn_and_fault("tip.force", "normal force of a tip", "safety.force_max",
        "contacts[{i}].force <= {share} * {safety.force_max}",
        lambda view, state, i, share: f"{FINGERS[i]} tip at {state.contacts[i].force:.1f} N, "
        f"above {share * view.limits.force_max:g} N"),
    *_warn_and_fault("tip.displacement", "displacement of a tip", "safety.d_max",
        "contacts[{i}].d <= {share} * {safety.d_max}",
        lambda view, state, i, share: f"{FINGERS[i]} tip at {state.contacts[i].d * 1e3:.2f} mm, "
        f"above {share * view.limits.d_max * 1e3:g} mm"),
    # |θ| ≤ share·(asin(1 − d/a) − margin): there the object's plane reaches the rim of the tip's
    # backing plate. Written with sin, which is defined for every finite angle.
    *_warn_and_fault("tip.tilt", "|θ| against asin(1 − d/a) less a margin", "safety.theta_margin",
        "contacts[{i}].inside and " + _LEAN + " <= 1.57 and "
        "sin(" + _LEAN + ") <= 1.0 - contacts[{i}].d / {tip.radius}",
        _tip_tilt),
    Limit("tactile.late", "age of the last sound frame: nothing is moved on", "limit",
        ("safety.frame_age_hold",), needs=_T, gripping=True),
    Limit("tactile.silent", "age of the last sound frame", "fault",
        ("safety.frame_age_fault", "safety.frame_age_action"), _T,
        "state.t - contacts[{i}].t_sound <= {frame_age}", _tactile_silent, gripping=True),
    Limit("tactile.frozen", "frames that are the same again and again while something touches",
        "fault", ("safety.frozen_after",), _T, check=_frozen),
    Limit("tactile.saturated", "share of full cells", "warn", ("safety.saturated",), _T,
        check=_saturated, lasts=0.1),
    Limit("tactile.misfit", "frames that fit no contact of the model", "warn", ("tactile.noise",),
        _T, "not contacts[{i}].misfit", lambda _, __, i, ___:
        f"tactile: what the {FINGERS[i]} tip feels fits no contact of the model; d and theta may "
        "be biased (another material, unequal cells, more noise than set)",
        in_turn=True, lasts=0.5),
    Limit("hand.angle", "object's angle by one finger against the other's", "warn",
        ("safety.residual_angle", "object.taper"), _T, check=_hand_angle, lasts=0.2, share=0.5),
    Limit("hand.angle", "object's angle by one finger against the other's", "fault",
        ("safety.residual_angle", "object.taper"), _T, check=_hand_angle, lasts=0.2),
    Limit("hand.width", "held object's width by joints and sensors, since it was gripped", "fault",
        ("safety.residual_width",), _T, check=_hand_width, remember=_remember_width, lasts=0.2),
    Limit("hand.force", "one tip's force against the other's", "warn", ("safety.residual_force",),
        _T, "not view.holds(state) or abs(contacts[0].force - contacts[1].force) <= "
        "{share} * {safety.residual_force} * max(contacts[0].force, contacts[1].force)",
        lambda _, state, *__: f"the tips feel {state.contacts[0].force:.1f} N and "
        f"{state.contacts[1].force:.1f} N of one grip", in_turn=True, lasts=0.3),
    Limit("hand.torque", "joint torque against what the tip feels", "warn",
        ("safety.residual_torque",), _T, check=_hand_torque, lasts=0.3),
    Limit("grip.slip", "shear against friction less a margin", "warn",
        ("control.tip_friction", "control.slip_margin"), _T,
        "not view.holds(state) or view.grasp.shear <= {share} * {friction}",
        lambda view, *_: f"shear is {view.grasp.shear:.2f} of the grip's force, above "
        f"{_usable(view.settings):.2f}: may slip", in_turn=True, lasts=0.1),
    Limit("commands.pace", "a client's commands a second; a stop counts, and is always heard",
        "limit", ("commands.per_second",)),
    Limit("loop.overruns", "late ticks in a row", "fault", ("safety.overruns_fault",),
        holds="state.timing.late_in_row < {safety.overruns_fault}",
        text=lambda _, state, *__: f"loop: {state.timing.late_in_row} overruns in a row"),
)  # fmt: skip
