"""The control law's modes: commands in, one goal for the servos a tick out.

What each mode does, and when it passes into the next. `control.modes` lists the commands,
`loop.requests` checks them, `control.grip` has the grip law, and `safety.safety` the limits,
which are not left to a control law.
"""

from __future__ import annotations

import math

from softfinger.daemon.control.grip import Grip
from softfinger.daemon.control.modes import GRIPPING, Mode
from softfinger.daemon.control.setpoint import Setpoint, SetpointState
from softfinger.daemon.perception.contact_filter_kernels import HOLDING, OTHER, RAMPING, GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Event, Goal, State

_GOAL_OFFSET = (
    0.35  # rad beyond the present angle: far enough that the servo's current bound decides
)
_ARRIVED = 0.03  # rad from the goal
_GRACE = 1.0  # s after the ramp's end in which a joint that friction holds may still arrive
_SETTLED_FORCE = 0.03  # share of the force target
_HELD_OVER = 0.12  # likewise: more than that gears don't hold of what came too much
_SETTLED_ANGLE = 0.5 * math.pi / 180.0
_SETTLED_FOR = 0.2  # s
_FOLLOWED = 0.25  # share of a stream's force, within which a grip follows it
_STEADY_FORCE = 0.02  # share, and …
_STEADY_ANGLE = 2e-3  # … rad, within which setpoints may flicker without counting as new ones
_TILT_RESERVE = 0.1  # rad of tilt kept from the limit that is a fault
_RAISED = 1.02  # of the force asked for, above which the grip is reported as raised
_LOST_AFTER = 0.1  # s without contact in a grip
_EMPTY_AFTER = 0.05  # s in which a grip is too narrow to hold anything


def off_range(angle: float, low: float, high: float) -> str:
    """Return what was found and expected of an angle [rad], in degrees and radians."""
    found, least, most = (f"{math.degrees(each):.1f}°" for each in (angle, low, high))
    return f"found {found} ({angle:.4g} rad), expected {least} to {most} ({low:.2f} to {high:.2f})"


class Control:
    """Modes and their laws. Only the loop's thread calls it, with commands that were checked."""

    def __init__(self, settings: Settings, state: State, grasp: GraspState) -> None:
        """``state`` and ``grasp`` are read at each tick, and never written."""
        self._settings = settings
        self._fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self._grip = Grip(settings, self._fingers, grasp)
        self._force = settings.control.force_default  # N that the next grip goes to
        self.mode = Mode.DISARMED
        self.torque = False  # what the servos' torque shall be
        self.events: list[Event] = []
        self._reading, self._contacts, self._pose = state.reading, state.contacts, state.object
        self._touched = [state.contacts[index] for index in self._fingers]
        self._held = grasp
        dt, smooth = 1.0 / settings.loop.rate, settings.control.smooth_time
        self._joints = [Setpoint(dt, smooth, SetpointState()) for _ in FINGERS]
        self._limp = True  # two ticks ago torque was off
        self._next_angle: float | None = None  # rad to turn to once the grip holds
        self._streamed = False  # the force is a stream's setpoint
        self._still = False  # holding, and nothing but loads moves the joints
        self._still_at = math.nan, math.nan  # force [N] and angle [rad] asked for then
        self._raised = False  # the grip is firmer than was asked for
        self._touching = [False, False]
        self._gripping = False
        self._hold_current = settings.safety.current_move  # A, with which the joints hold a goal
        self._waiting = 0.0  # s since the ramps ended, or the grip has been settled
        self._lost = 0.0  # s without contact in a grip
        self._empty = 0.0  # s in which a grip has been too narrow to hold anything
        self._turn_ended = False  # before its target, since the tips would slip

    # Commands

    def fail(self, reason: str, name: str) -> None:
        """Latch a fault: torque off until ``clear``. ``name`` is its row of `safety.limits`."""
        self._enter(Mode.FAULT)
        self.torque = False
        self.events.append(("error", name, reason))

    def arm(self) -> None:
        """Switch torque on, with the joints held where they are."""
        self._hold_here()
        self.torque = True
        self._enter(Mode.ARMED)

    def disarm(self) -> None:
        """Switch torque off; also the way out of a fault."""
        self.torque = False
        self._enter(Mode.DISARMED)

    def stop(self) -> None:
        """Switch torque off; a fault stays latched."""
        self.torque = False
        if self.mode is not Mode.FAULT:
            self._enter(Mode.DISARMED)

    def move(self, **angles: float) -> None:
        """Move the joints to these angles [rad], ``left`` and ``right`` or one of them."""
        if self.mode is not Mode.MOVING:
            self._hold_here()
        for name, q in angles.items():
            self._joints[FINGERS.index(name)].target = q
        self._enter(Mode.MOVING)

    def grasp(self, force: float) -> None:
        """Close until all fingers touch, then a mean tip force of ``force`` [N].

        A hand that grips already goes to that force and stays in its mode.
        """
        self._streamed = False
        if self._gripping:
            self._grip.retarget(force)
            self._unsettle()
            return
        if self.mode is not Mode.GRASPING:
            self._hold_here()
            self._touching = [False, False]
        self._turn_ended = False
        self._force = force
        self._enter(Mode.GRASPING)

    def ease(self, most: float, seconds: float) -> None:
        """Let this grip come down to ``most`` [N] within ``seconds``, and press no more after."""
        self._grip.ease(most, seconds)
        self._unsettle()

    def load_needs(self) -> float:
        """Return the force [N] that the load of the grip needs with its margin."""
        return self._grip.load_needs()

    def rotate(self, angle: float) -> None:
        """Turn the object to ``angle`` [rad]; while grasping, once the grip holds."""
        if self.mode is Mode.GRASPING:
            self._next_angle = angle
            return
        self._grip.steer(self._pose.angle, angle)
        self._turn_ended = False
        self._enter(Mode.ROTATING)

    def hold(self, force: float | None = None, angle: float | None = None) -> float | None:
        """Take setpoints of a stream: a grip's ``force`` [N], the object's ``angle`` [rad].

        A hand that doesn't grip yet grasps first, with ``force``. The setpoints go there at
        `control.rotate_speed` and in `control.force_time`, smoothly whatever the stream. Return the
        angle that is turned to, bounded by what this grip reaches; None where none is known yet.
        """
        if force is not None and not (self._gripping and force == self._grip.commanded):
            self.grasp(force)
            self._streamed = True
        if angle is None:
            return None
        if self.mode is Mode.GRASPING:
            self._next_angle = angle
            return None
        low, high = self._turns()
        angle = min(max(angle, low), high)
        self._grip.steer(self._pose.angle, angle)
        self._unsettle()
        return angle

    def _unsettle(self) -> None:
        """Take that what is asked for has changed: the grip is still again once it is there."""
        force, angle = self._still_at
        grip = self._grip
        if self._still and not (
            abs(grip.commanded - force) < _STEADY_FORCE * force
            and (math.isnan(grip.target_angle) or abs(grip.target_angle - angle) < _STEADY_ANGLE)
        ):
            self._still = False
            self._waiting = 0.0

    @property
    def phase(self) -> int:
        """The grip's phase, by which perception takes torques for what they tell."""
        if self._still:
            return HOLDING
        # A force that a turn began with has shown what torques tell of it.
        known = self.mode is Mode.ROTATING and self._grip.commanded == self._still_at[0]
        tells = self.mode in GRIPPING and not (self._grip.turning or known or self._empty > 0.0)
        return RAMPING if tells else OTHER

    def set(self, compliance: float) -> None:
        """Set the angle by which the grip gives way to a torque [rad/(N·m)]."""
        self._grip.set_joint_stiffness(1.0 / compliance)

    def why_not_turn(self, angle: float) -> str:
        """Return why the held object can't be turned to ``angle`` [rad] now; empty where it can."""
        if not self._pose.valid:
            return "the object's angle is not known"
        low, high = self._turns()
        if low <= angle <= high:
            return ""
        return f"angle: {off_range(angle, low, high)} in this grip"

    def _turns(self) -> tuple[float, float]:
        """The object's angles [rad] that this grip reaches within the tips' and joints' limits.

        While the object turns by φ, each joint leans by φ over the sum of its turns, and each tip's
        tilt changes by both.
        """
        settings, present = self._settings, self._pose.angle
        lean = 1.0 / max(self._held.jacobian_rotation[0] + self._held.jacobian_rotation[1], 0.1)
        low, high = -math.inf, math.inf
        for index, sense in ((0, 1.0), (1, -1.0)):
            contact, q = self._contacts[index], self._reading.q[index]
            depth = 1.0 - contact.d / settings.tip.radius
            reach = math.asin(max(depth, 0.0)) - settings.safety.theta_margin - _TILT_RESERVE
            low = max(low, (-reach - contact.theta) / (1.0 + lean))
            high = min(high, (reach - contact.theta) / (1.0 + lean))
            down, up = settings.hand.q_min[index] - q, settings.hand.q_max[index] - q
            ends = sorted((sense * down / lean, sense * up / lean))
            low, high = max(low, ends[0]), min(high, ends[1])
        return present + min(low, 0.0), present + max(high, 0.0)

    def release(self) -> None:
        """Open to the hand's open angles."""
        self._hold_here()
        for index in self._fingers:
            self._joints[index].target = self._settings.hand.open_angle[index]
        self._gripping = False
        self._enter(Mode.RELEASING)

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self.events.append(("info", "mode", f"{self.mode.value} → {mode.value}"))
        self.mode = mode
        if self._next_angle is not None and mode not in (Mode.GRASPING, Mode.HOLDING):
            self._next_angle = None
            text = f"rotate: dropped, since the grasp ended in {mode.value}"
            self.events.append(("warning", "rotate", text))
        self._hold_current = self._settings.safety.current_move
        self._waiting = self._lost = self._empty = 0.0
        self._still = False
        if mode in (Mode.DISARMED, Mode.ARMED, Mode.FAULT):
            self._gripping = False

    def _hold_here(self) -> None:
        for index, q in enumerate(self._reading.q):
            self._joints[index].reset(q)

    # One tick

    def step(self, dt: float, goal: Goal) -> None:
        """Fill ``goal`` for this tick; ``goal.valid`` is False while torque is to be off."""
        limp, self._limp = self._limp, not goal.valid
        goal.valid = self.torque
        goal.force = goal.angle = math.nan
        if not self.torque:
            return
        mode = self.mode
        if limp and mode is Mode.ARMED:
            self._hold_here()  # torque has gone on since the last tick: the joints may have moved
        if mode is Mode.MOVING or mode is Mode.RELEASING:
            self._travel(dt)
        elif mode is Mode.GRASPING and not self._gripping:
            self._approach(dt)
        if self._gripping:
            self._hold(dt, goal)
        else:
            self._rest(
                goal, self._approach_current() if mode is Mode.GRASPING else self._hold_current
            )
        if self._gripping:
            goal.force, goal.angle = self._grip.target, self._grip.target_angle
        elif self.mode is Mode.GRASPING:
            goal.force = self._force

    def hold_goal(self, goal: Goal) -> None:
        """Replace :meth:`step` while frames are late: goals stay as they are.

        A grip's goals are torques: its joints are damped, and a turn comes to rest.
        """
        if goal.valid and self._gripping and self._lost == 0.0:
            self._pull(self._grip.hold_goal(self._reading), goal)

    def _rest(self, goal: Goal, current: float) -> None:
        """Joints follow their setpoints, with at most ``current`` [A]."""
        for index in self._fingers:
            goal.q[index] = self._joints[index].value
            goal.current[index] = current

    def _step(self, rate: float) -> bool:
        """Move the joints' setpoints, at most ``rate`` rad/s; whether all are at their targets."""
        there = [joint.step(rate) for joint in self._joints]
        return all(there)

    def _travel(self, dt: float) -> None:
        if not self._step(self._settings.control.move_speed):
            return
        self._waiting += dt
        off = max(abs(self._reading.q[i] - self._joints[i].target) for i in self._fingers)
        if off < _ARRIVED or self._waiting > _GRACE:
            if off >= _ARRIVED:
                text = f"{self.mode.value} ended {math.degrees(off):.1f}° short of its goal"
                self.events.append(("warning", "short", text))
            self._enter(Mode.ARMED)

    def _approach(self, dt: float) -> None:
        """Close until every finger touches; a finger that touches waits for the other."""
        law, awaited = self._settings.control, False
        for index in self._fingers:
            contact = self._contacts[index]
            touches = contact.valid and contact.contact and contact.force > law.contact_force
            if touches and not self._touching[index]:
                self._joints[index].reset(self._reading.q[index])
            self._touching[index] = touches
            if not touches:
                self._joints[index].target = self._settings.hand.q_max[index]
                awaited = True
        if not awaited:
            if not self._is_empty(dt):
                self._gripping = True
                self._grip.most = math.inf
                self._grip.start(self._felt(), self._force)
        elif self._step(law.approach_speed):
            self._waiting += dt
            if self._waiting > _GRACE:
                text = "nothing to grasp within the joints' limits"
                self.events.append(("warning", "grasp", text))
                self._hold_here()
                self._enter(Mode.ARMED)

    def _felt(self) -> float:
        """Mean force of the tips [N]."""
        return sum(contact.force for contact in self._touched) / len(self._touched)

    def _approach_current(self) -> float:
        """A tip that meets the object before it is felt shall not press beyond the force wanted."""
        law = self._settings.control
        pressed = 0.5 * self._force * self._settings.hand.finger_length * law.driving
        pressed += law.joint_friction
        return min(law.approach_current, pressed / law.torque_constant)

    def _hold(self, dt: float, goal: Goal) -> None:
        for contact in self._touched:
            if not contact.contact:
                self._lose(dt, goal)
                return
        if self._lost > 0.0:
            self._still = False  # the force is built up again: what moves joints is no load
            self._waiting = self._lost = 0.0
        self._is_empty(dt)
        self._pull(self._grip.torques(self._reading, self._pose, self._still), goal)
        self._watch_slip()
        if not self._still:
            if self.mode is not Mode.GRASPING:
                self._watch_turning()
            self._watch_settling(dt)

    def _pull(self, torques: tuple[float, float], goal: Goal) -> None:
        for index in self._fingers:
            current = torques[index] / self._settings.control.torque_constant
            goal.q[index] = self._reading.q[index] + math.copysign(_GOAL_OFFSET, current)
            goal.current[index] = abs(current)

    def _lose(self, dt: float, goal: Goal) -> None:
        """Hold the joints where they are without a contact; end the grip when it stays away."""
        if self._lost == 0.0:
            self._hold_here()
            # A board that went blind must not make the joints press harder than they did.
            pressed = max(goal.current[index] for index in self._fingers)
            self._hold_current = min(pressed, self._settings.safety.current_move)
        self._rest(goal, self._hold_current)
        self._lost += dt
        if self._lost > _LOST_AFTER:
            self.events.append(("warning", "lost", "contact lost; the joints hold where they are"))
            rest = self._hold_current
            self._enter(Mode.ARMED)
            self._hold_current = rest

    def _is_empty(self, dt: float) -> bool:
        """Return whether there seems to be nothing between the tips; if that lasts, the hand opens.

        Tips that press each other would roll off to one side. Their contacts are one, so that the
        object's width by joints and sensors is 0 up to their errors.
        """
        width_min = self._settings.object.width_min
        if not self._pose.valid or self._pose.width >= width_min:
            self._empty = 0.0
            return False
        self._empty += dt
        if self._empty > _EMPTY_AFTER:
            text = (
                f"nothing between the tips: {self._pose.width * 1e3:.1f} mm, "
                f"less than object.width_min {width_min * 1e3:g} mm; opening"
            )
            self.events.append(("warning", "grasp", text))
            self.release()
        return True

    def _watch_slip(self) -> None:
        """Report when the grip is raised against slip."""
        grip = self._grip
        if grip.slipped:
            self.events.append(("warning", "slip", "the object turns in the grip"))
        if grip.target <= grip.commanded:
            self._raised = False
        elif grip.target > _RAISED * grip.commanded and not self._raised:
            self._raised = True
            why = "the object turns in it" if grip.slipped else "a load came at once"
            if grip.slip.guarded > 0.0:
                why = f"each tip may bear {grip.slip.guarded:.1f} N along its face"
            text = f"grip raised above {grip.commanded:.1f} N: {why}"
            self.events.append(("warning", "slip", text))

    def _watch_turning(self) -> None:
        """Turning ends where the tips would slip."""
        grip, law, angle = self._grip, self._settings.control, self._pose.angle
        shear_max = law.tip_friction * (1.0 - law.slip_margin)
        if not self._held.shear * grip.turning_on > shear_max:
            return
        if not self._turn_ended:
            text = f"turning ended at {math.degrees(angle):.1f}°: the tips would slip"
            self.events.append(("warning", "slip", text))
        self._turn_ended = True
        grip.steer(angle, angle)

    def _watch_settling(self, dt: float) -> None:
        """Pass into holding once the force, or the angle while turning, has stayed at its goal."""
        grip, pose = self._grip, self._pose
        settled = self.mode is Mode.GRASPING or not (
            abs(pose.angle - grip.target_angle) >= _SETTLED_ANGLE
        )
        if self.mode is not Mode.ROTATING:
            # The mean, since what the object rubs on may take some force between the tips.
            wanted = grip.target
            if self._streamed and self.mode is Mode.GRASPING:  # it may never rest
                wanted = grip.force.value
                settled = abs(wanted - grip.target) < _FOLLOWED * grip.target
            most = _SETTLED_FORCE + min(self._settings.control.load_held, _HELD_OVER)
            off = self._felt() - wanted
            settled = settled and -_SETTLED_FORCE * grip.target < off < most * grip.target
            settled = settled and not grip.shaking
        self._waiting = self._waiting + dt if settled else 0.0
        if self._waiting <= _SETTLED_FOR:
            return
        if pose.valid and math.isnan(grip.target_angle) and not grip.upright:
            grip.steer(pose.angle, pose.angle)
        grip.begin_holding()
        self._enter(Mode.HOLDING)
        self._still = True
        self._still_at = grip.commanded, grip.target_angle
        if self._next_angle is None:
            return
        angle, self._next_angle = self._next_angle, None  # a turn that waited for the grip
        if refusal := self.why_not_turn(angle):
            self.events.append(("warning", "rotate", f"rotate: {refusal}"))
        else:
            self.rotate(angle)
