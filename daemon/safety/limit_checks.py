"""How each limit is judged: one function a row of `safety.limits.ROWS`, pure but for a `View`.

A check takes the view, the state and a share of its bound, and gives what stands as a sentence, or
an empty text. It may be asked at any tick or at none; what lasts how long is not its business.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.control.modes import GRIPPING, HELD
from softfinger.daemon.perception.contact_filter import GraspState
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.joint_motion import JointMotion
from softfinger.daemon.servos.control_table import VOLTAGE_UNIT, by_name, hardware_error_names
from softfinger.daemon.types import FINGERS, Frame, State

PAST_STOP = 0.1  # rad beyond a joint limit that a push may take a joint
_FULL_CURRENT = 0.9  # of a goal's bound: a joint that takes more has no reserve
_ALL = 0.95  # of the greatest current there may be: a grip that takes more can't be firmer
_SLOW = 0.05  # rad/s below which a joint stands
_OFF = 0.05  # rad off its goal from which on a joint must be pulled there …
_PULL = 2.0  # … with so much current [A/rad]: less than any model's own loop gives
_FELT = 0.04  # A that must be expected for that to be judged
_PULLED = 0.25  # of what is expected


class View:
    """What the rows look at beside the state: the scene, and what a few of them remember."""

    def __init__(
        self,
        settings: Settings,
        grasp: GraspState | None = None,
        sensors: Sequence[FingerPerception] = (),
    ) -> None:
        self.settings = settings
        self.limits = settings.safety
        self.hand = settings.hand
        self.fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self.grasp = GraspState() if grasp is None else grasp
        self.sensors = sensors
        self.frame_period = 1.0 / settings.tactile.rate
        self.motion = JointMotion(self.fingers, self.limits.velocity_max, 1.0 / settings.loop.rate)
        servos = settings.servos  # in current mode the pull is the daemon's own
        self.pull = min(_PULL, 0.5 * servos.stiffness) if servos.mode == "current" else _PULL
        self.no_number = False  # a goal was none since the last judgement
        self.grip_width = math.nan  # of the object when it was gripped [m]
        self.seen: list[Frame | None] = [None, None]
        self.changed = [0.0, 0.0]  # when a frame last differed from the one before it [s]
        low, high = settings.safety.voltage_min, settings.safety.voltage_max
        if settings.servos.backend != "none":
            model = by_name(settings.servos.model)
            low = low or model.voltage_min * VOLTAGE_UNIT
            high = high or model.voltage_max * VOLTAGE_UNIT
        self.voltage = (low, high)

    def frames_older(self, state: State, periods: float) -> bool:
        """Whether a finger's last sound frame came more than so many periods ago."""
        oldest = state.t - periods * self.frame_period
        return any(state.contacts[index].t_sound < oldest for index in self.fingers)

    def touching(self, state: State) -> list[int]:
        """Fingers whose tip soundly feels something."""
        found = []
        for index in self.fingers:
            contact = state.contacts[index]
            if contact.valid and contact.contact:
                found.append(index)
        return found

    def both_held(self, state: State) -> bool:
        """Both tips soundly hold an object of known angle and width."""
        return state.object.valid and len(self.touching(state)) == 2


# --- servos and joints: (view, state, share of the bound) → what stands, or an empty text --------


def servos_silent(view: View, state: State, _: float) -> str:
    age = state.t - state.reading.t
    if age == math.inf:
        return "servos: no good reading yet"
    return f"servos: no good reading for {age:.3f} s" if not age <= reading_age(view) else ""


def reading_age(view: View) -> float:
    """The age [s] of a servo reading above which the servos count as silent."""
    return view.settings.servos.fault_after


def servo_alert(view: View, state: State, _: float) -> str:
    reading = state.reading
    if not reading.alert:
        return ""
    told = []
    for index in view.fingers:
        if reading.alert >> index & 1:
            status = reading.hardware[index]
            what = f" ({hardware_error_names(status)})" if status else ""
            told.append(f"{FINGERS[index]}{what}")
    return f"servos: hardware error reported by {' and '.join(told)}"


def _named(view: View, bits: int) -> str:
    return " and ".join(FINGERS[index] for index in view.fingers if bits >> index & 1)


def servo_frozen(view: View, state: State, _: float) -> str:
    frozen = _named(view, state.reading.frozen)
    return f"servos: old readings from {frozen}: its own clock stands still" * bool(frozen)


def goal_lost(view: View, state: State, _: float) -> str:
    lost = _named(view, state.reading.lost)
    return f"servos: none of the goals sent lately reached {lost}: check the cable" * bool(lost)


def joint_angle(view: View, state: State, _: float) -> str:
    for index in view.fingers:
        q = state.reading.q[index]
        if not view.hand.q_min[index] - PAST_STOP <= q <= view.hand.q_max[index] + PAST_STOP:
            return f"{FINGERS[index]} joint at {q:.3f} rad, outside its limits"
    return ""


def joint_velocity(view: View, state: State, _: float) -> str:
    for index in view.fingers:
        dq = state.reading.dq[index]
        if not abs(dq) <= view.limits.velocity_max:
            return f"{FINGERS[index]} joint at {dq:.2f} rad/s, too fast"
    return ""


def joint_jump(view: View, state: State, _: float) -> str:
    jumped = _named(view, view.motion.jumped)
    if not jumped:
        return ""
    return (
        f"{jumped} joint's angle went where its velocity did not: its encoder, or what turns it, "
        "has slipped"
    )


def joint_dead(view: View, state: State, _: float) -> str:
    """Off its goal it stands, and no current pulls it there. A joint that is held back takes some.

    In position mode nothing is known of the current that it should take.
    """
    goal, reading = state.goal, state.reading
    if not (state.torque and goal.valid) or view.settings.servos.mode == "position":
        return ""
    for index in view.fingers:
        error = goal.q[index] - reading.q[index]
        if abs(error) < _OFF or abs(reading.dq[index]) > _SLOW:
            continue
        expected = min(goal.current[index], view.pull * abs(error))
        toward = math.copysign(1.0, error) * reading.current[index]
        if expected > _FELT and toward < _PULLED * expected:
            return (
                f"{FINGERS[index]} joint stands {math.degrees(abs(error)):.1f}° off its goal and "
                f"takes {toward:.2f} A of {goal.current[index]:.2f} A to get there: encoder, "
                "current sensor or motor"
            )
    return ""


def joint_current(view: View, state: State, _: float) -> str:
    for index in view.fingers:
        current, bound = state.reading.current[index], view.limits.current_fault
        if not abs(current) <= bound:
            return f"{FINGERS[index]} joint takes {current:.2f} A, above {bound:g} A"
    return ""


def joint_stall(view: View, state: State, _: float) -> str:
    if not state.torque or not state.goal.valid or state.mode in GRIPPING:
        return ""
    reading, goal = state.reading, state.goal
    by_current = view.settings.servos.mode != "position"
    for index in view.fingers:
        error = goal.q[index] - reading.q[index]
        bound = goal.current[index] if by_current else view.limits.current_max
        if (
            abs(error) > view.limits.stall_error
            and abs(reading.current[index]) >= _FULL_CURRENT * bound
            and abs(reading.dq[index]) < _SLOW
        ):
            return (
                f"{FINGERS[index]} joint has stalled, {math.degrees(abs(error)):.1f}° off its goal "
                f"at {abs(reading.current[index]):.2f} A"
            )
    return ""


def joint_strained(view: View, state: State, share: float) -> str:
    if not state.torque or state.mode not in GRIPPING:
        return ""
    for index in view.fingers:
        if abs(state.reading.current[index]) >= _ALL * share * view.limits.current_max:
            return f"{FINGERS[index]} joint grips with all of its {view.limits.current_max:g} A"
    return ""


def _hot(view: View, state: State, bound: float) -> str:
    for index in view.fingers:
        temperature = state.reading.temperature[index]
        if temperature >= bound:
            return f"{FINGERS[index]} servo at {temperature:.0f} °C"
    return ""


def temperature_warn(view: View, state: State, share: float) -> str:
    return _hot(view, state, share * view.limits.temperature_warn)


def temperature(view: View, state: State, share: float) -> str:
    return _hot(view, state, share * view.limits.temperature_max)


def voltage(view: View, state: State, _: float) -> str:
    low, high = view.voltage
    for index in view.fingers:
        voltage = state.reading.voltage[index]
        if voltage and not low <= voltage <= high:
            return (
                f"{FINGERS[index]} servo's supply at {voltage:.1f} V, "
                f"outside {low:.1f} to {high:.1f} V"
            )
    return ""


# --- tips and object ------------------------------------------------------------------------


def tip_force(view: View, state: State, share: float) -> str:
    bound = share * view.limits.force_max
    for index in view.touching(state):
        force = state.contacts[index].force
        if not force <= bound:
            return f"{FINGERS[index]} tip at {force:.1f} N, above {bound:g} N"
    return ""


def tip_displacement(view: View, state: State, share: float) -> str:
    bound = share * view.limits.d_max
    for index in view.touching(state):
        d = state.contacts[index].d
        if not d <= bound:
            return f"{FINGERS[index]} tip at {d * 1e3:.2f} mm, above {bound * 1e3:g} mm"
    return ""


def tip_tilt(view: View, state: State, share: float) -> str:
    for index in view.touching(state):
        contact = state.contacts[index]
        # asin((a − d)/a): the object's plane reaches the rim of the tip's backing plate
        depth = max(1.0 - contact.d / view.settings.tip.radius, 0.0)
        limit = share * (math.asin(min(depth, 1.0)) - view.limits.theta_margin)
        if not contact.inside or not abs(contact.theta) <= limit:
            return (
                f"{FINGERS[index]} tip at {math.degrees(contact.theta):.1f}°, "
                f"past {math.degrees(limit):.1f}° at this depth"
            )
    return ""


def hand_angle(view: View, state: State, share: float) -> str:
    if not view.both_held(state) or len(view.sensors) < 2:
        return ""
    left, right = (sensor.estimate for sensor in view.sensors)  # of the newest frames alone
    bound = share * view.limits.residual_angle
    if not (left.contact and right.contact) or left.tilt_x_std + right.tilt_x_std > 0.25 * bound:
        return ""
    q = state.reading.q
    apart = (left.tilt_x - q[0]) - (right.tilt_x + q[1]) + view.settings.object.taper
    if abs(apart) <= bound:
        return ""
    return (
        f"the fingers see the object's angle {math.degrees(abs(apart)):.1f}° apart: the object "
        "lies askew between the tips or tapers (object.taper), a sensor has shifted, or its centre "
        "or rotation is wrong"
    )


def hand_width(view: View, state: State, share: float) -> str:
    if state.mode not in HELD or not view.both_held(state):
        view.grip_width = math.nan
        return ""
    width = state.object.width
    if math.isnan(view.grip_width):
        view.grip_width = width
    changed = width - view.grip_width
    if abs(changed) <= share * view.limits.residual_width:
        return ""
    return (
        f"the held object's width changed by {changed * 1e3:+.1f} mm since it was gripped: "
        "a sensor has shifted, or a joint's zero"
    )


def hand_force(view: View, state: State, share: float) -> str:
    if state.mode not in HELD or not view.both_held(state):
        return ""
    left, right = state.contacts[0].force, state.contacts[1].force
    if abs(left - right) <= share * view.limits.residual_force * max(left, right):
        return ""
    return f"the tips feel {left:.1f} N and {right:.1f} N of one grip"


def hand_torque(view: View, state: State, share: float) -> str:
    if state.mode not in HELD or not view.both_held(state):
        return ""
    control, grasp = view.settings.control, view.grasp
    for index in view.fingers:
        wanted = grasp.lever[index] * 0.5 * (state.contacts[0].force + state.contacts[1].force)
        found = control.torque_constant * state.reading.current[index]
        free = share * view.limits.residual_torque * abs(wanted) + 2.0 * control.joint_friction
        if abs(found - wanted) > free:
            return (
                f"{FINGERS[index]} joint gives {found:.2f} N·m, its tip feels what takes "
                f"{wanted:.2f} N·m"
            )
    return ""


def slip(view: View, state: State, share: float) -> str:
    control = view.settings.control
    if state.mode not in HELD or not view.both_held(state):
        return ""
    bound = share * control.tip_friction * (1.0 - control.slip_margin)
    if view.grasp.shear <= bound:
        return ""
    return f"shear is {view.grasp.shear:.2f} of the grip's force, above {bound:.2f}: may slip"


# --- tactile frames -------------------------------------------------------------------------


def frames_silent(view: View, state: State, _: float) -> str:
    if not view.frames_older(state, view.limits.frame_age_fault):
        return ""
    stalest = min((state.contacts[i] for i in view.fingers), key=lambda each: each.t_sound)
    age = state.t - stalest.t_sound
    what = "frame" if stalest.t_arrival == stalest.t_sound else "sound estimate"
    return f"tactile: no {what} for {age:.3f} s"


def frozen(view: View, state: State, _: float) -> str:
    after = view.limits.frozen_after
    if after <= 0.0:
        return ""
    found = ""
    for sensor in view.sensors:
        finger, frame, seen = sensor.finger, sensor.frame, view.seen[sensor.finger]
        if frame is None:
            continue
        if frame is not seen:
            if seen is None or not _same(frame.data, seen.data):
                view.changed[finger] = frame.t_arrival
            view.seen[finger] = frame
        same = frame.t_arrival - view.changed[finger]
        if same > after and state.contacts[finger].contact:
            found = f"tactile: {FINGERS[finger]} sensor frozen, the same frame for {same:.2f} s"
    return found


def _same(data: NDArray[np.uint16], other: NDArray[np.uint16]) -> bool:
    """Equal in every cell. Live frames differ in their middle row already, which is quick."""
    middle = len(data) // 2
    if data.shape == other.shape and data[middle].tobytes() != other[middle].tobytes():
        return False
    return np.array_equal(data, other)


def misfit(view: View, state: State, _: float) -> str:
    for finger in view.fingers:
        if state.contacts[finger].misfit:
            return (
                f"tactile: what the {FINGERS[finger]} tip feels fits no contact of the model; d "
                "and theta may be biased (another material, unequal cells, more noise than told)"
            )
    return ""


def saturated(view: View, state: State, share: float) -> str:
    full, most = view.settings.tactile.full_count, share * view.limits.saturated
    for sensor in view.sensors:
        if sensor.frame is None:
            continue
        data = sensor.frame.data
        part = np.count_nonzero(data >= full) / data.size
        if part > most:
            return f"tactile: {part:.0%} of the {FINGERS[sensor.finger]} sensor's cells are full"
    return ""


def overrunning(view: View, state: State, _: float) -> str:
    late = state.timing.late_in_row
    return f"loop: {late} overruns in a row" if late >= view.limits.overruns_fault else ""


def no_number(view: View, _: State, __: float) -> str:
    return "control: a goal was no number" if view.no_number else ""
