"""The control's state machine: commands in, one goal for the servos a tick out.

State        Mode       What happens                     Cause → next state
-----------  ---------  -------------------------------  ------------------------------------------
Off          DISARMED   torque is off                    `arm` → Armed
             FAULT      torque is off                    `clear` → Off (DISARMED)
Armed        ARMED      joints hold where they are       `move` → Travelling (MOVING);
                                                         `grasp`, `hold` → Approaching
Travelling   MOVING     joints go to commanded angles    arrived, or _GRACE over → Armed;
                                                         `grasp`, `hold` → Approaching
             RELEASING  joints go to the open angles     arrived, or _GRACE over → Armed
Approaching  GRASPING   fingers close; one that touches  all touch → Pressing; at the joints' ends
                        waits for the other              for _GRACE → Armed
Pressing     GRASPING   the force is built up            force reached → Settled, and from there
                                                         Turning, if an angle was asked for
Settled      HOLDING    force and angle are held: only   `grasp`, `hold` or `ease` with another
                        loads move the joints            value, contact lost and back → Changing
Changing     HOLDING    force or angle is on its way     force and angle reached → Settled
Turning      ROTATING   the object turns                 angle reached → Settled

Transitions that several states have in common:

- all: a fault → Off (FAULT); `stop`, `disarm` → Off (DISARMED), but a fault stays until `clear`
- with torque: `release` → Travelling (RELEASING)
- Settled, Changing, Turning: `rotate` → Turning
- Approaching, Pressing, Settled, Changing, Turning: tips touch each other for _EMPTY → Travelling
  (RELEASING)
- Pressing, Settled, Changing, Turning: a contact is missing for _LOST → Armed. Until then the
  joints hold where they are (`ContactLoss`).

Each transition makes a new object of a class below. Timers and flags are attributes of the state
that uses them, so they end with it. `control.modes` has the commands of each mode, `loop.requests`
checks them, `control.fingers` drives the joints, `control.grip` has the grip law, and
`safety.safety` bounds the goals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from softfinger.daemon.control.fingers import Fingers
from softfinger.daemon.control.grip import Grip
from softfinger.daemon.control.modes import Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Event, Goal, State

# rad off its goal, within which a joint has arrived: five times what the default joint friction
# leaves at the default servos.stiffness.
_ARRIVED = 0.03
# s after its setpoint's arrival that a joint has to follow; then friction holds it for good.
_GRACE = 1.0
# Share of the force target: the force scatters by 0.3 to 0.6 % (1 σ) with simulated sensors.
_FORCE_REACHED = 0.03
# Share of the force target that gears may hold above it, besides: 6 % in the small hand.
_HELD_OVER = 0.12
# Share of the force target that friction may hold: 0.05 N·m at the default finger are a tenth of
# 6 N. The force law brings it in the end, which takes s, since it grows with the error.
_NEAR = 0.1
# s after which such a force is reached, too: ten times what the law takes without friction.
_STUCK = 2.0
# rad off the angle's target: the angle scatters by 0.5 to 2 mrad (1 σ) with simulated sensors.
_ANGLE_REACHED = math.radians(0.5)
# s for which force and angle have to stay reached: five frames at 25 Hz, two default smooth_time.
_SETTLED = 0.2
# Share of the force target: a streamed target may never rest, so a grip also counts as built up
# when it follows its setpoint so near to the target.
_FOLLOWED = 0.25
# Share of the force, and rad (1 σ of the angle): a stream's setpoints and a raise of the grip
# that change less are flicker.
_FORCE_FLICKER, _ANGLE_FLICKER = 0.02, 2e-3
# s without a contact: two frames at 25 Hz that could show it again.
_LOST = 0.1
# s in which the tips seem to touch each other: more than one frame at 25 Hz.
_EMPTY = 0.05


class ControlState:
    """Base of the states."""

    mode: Mode


@dataclass
class Off(ControlState):
    """DISARMED, or FAULT until the fault is cleared."""

    mode: Mode = Mode.DISARMED


@dataclass
class Armed(ControlState):
    """The joints hold where they are."""

    mode = Mode.ARMED
    current: float  # at most [A]
    following: int = 0  # ticks in which setpoints still follow the joints


@dataclass
class Travelling(ControlState):
    """The joints go to their setpoints' targets: MOVING or RELEASING."""

    mode: Mode
    arrived_for: float = 0.0  # since the setpoints are there [s]


@dataclass
class Order:
    """Commands to a grasp, kept until it has settled."""

    force: float  # [N]
    is_streamed: bool  # the force is a stream's setpoint
    angle: float | None = None  # to turn to after that [rad]


@dataclass
class Approaching(ControlState):
    """The fingers close."""

    mode = Mode.GRASPING
    order: Order
    touching: set[int] = field(default_factory=set)  # fingers
    arrived_for: float = 0.0  # since the setpoints are at the joints' ends [s]
    empty_for: float = 0.0  # since the tips seem to touch each other [s]


@dataclass
class ContactLoss:
    """A contact is missing: the joints hold where they are."""

    current: float  # at most [A]
    lost_for: float = 0.0  # [s]


@dataclass
class GripHistory:
    """Data that the states of one grip share, from the touch of all fingers to its end."""

    loss: ContactLoss | None = None
    empty_for: float = 0.0  # since the tips seem to touch each other [s]
    settled_force: float = math.nan  # asked for when it settled last [N]
    settled_angle: float = math.nan  # likewise [rad]
    raise_reported: bool = False
    turn_end_reported: bool = False


@dataclass
class Gripping(ControlState):
    """Base of the states in which the grip law gives the joints' torques."""

    history: GripHistory
    reached_for: float = 0.0  # since force and angle are at their targets [s]
    near_for: float = 0.0  # since the force is so near that friction may hold the rest [s]


@dataclass(kw_only=True)
class Pressing(Gripping):
    """The force is built up."""

    mode = Mode.GRASPING
    order: Order


class Settled(Gripping):
    """Force and angle are held: only loads move the joints."""

    mode = Mode.HOLDING


class Changing(Gripping):
    """Force or angle is on its way to another target."""

    mode = Mode.HOLDING


class Turning(Gripping):
    """The object turns."""

    mode = Mode.ROTATING


class Control:
    """The state machine and its commands. Only the loop's thread calls it."""

    def __init__(self, settings: Settings, state: State, grasp: GraspState) -> None:
        """``state`` and ``grasp`` are read at each tick, and never written."""
        self._settings = settings
        self.fingers = Fingers(settings, state, grasp)
        self.grip = Grip(settings, self.fingers.indices, grasp)
        self.state: ControlState = Off()
        self.events: list[Event] = []

    @property
    def mode(self) -> Mode:
        """Mode of the hand."""
        return self.state.mode

    @property
    def torque(self) -> bool:
        """True if the servos' torque shall be on."""
        return not isinstance(self.state, Off)

    def _enter(self, state: ControlState) -> None:
        last, self.state = self.state, state
        if state.mode is not last.mode:
            self.events.append(("info", "mode", f"{last.mode.value} → {state.mode.value}"))
        waits = isinstance(last, Approaching | Pressing) and last.order.angle is not None
        if waits and not isinstance(state, Approaching | Gripping):
            self._warn("rotate", f"rotate: dropped, since the grasp ended in {state.mode.value}")

    def _stay(self) -> None:
        self._enter(Armed(self._settings.safety.current_move))

    def _warn(self, kind: str, text: str) -> None:
        self.events.append(("warning", kind, text))

    # Commands

    def fail(self, reason: str, name: str) -> None:
        """Latch a fault: torque off until ``clear``. ``name`` is its row of `safety.limits`."""
        self._enter(Off(Mode.FAULT))
        self.events.append(("error", name, reason))

    def arm(self) -> None:
        """Switch torque on, with the joints held where they are."""
        # Torque goes on at the end of the first tick: until the second one the joints may move.
        self._enter(Armed(self._settings.safety.current_move, following=2))

    def disarm(self) -> None:
        """Switch torque off; also the way out of a fault."""
        self._enter(Off())

    def stop(self) -> None:
        """Switch torque off; a fault stays latched."""
        if self.mode is not Mode.FAULT:
            self._enter(Off())

    def move(self, **angles: float) -> None:
        """Move the joints to these angles [rad], ``left`` and ``right`` or one of them."""
        if self.mode is not Mode.MOVING:
            self.fingers.hold_here()
        for name, q in angles.items():
            self.fingers.go_to(FINGERS.index(name), q)
        self._enter(Travelling(Mode.MOVING))

    def release(self) -> None:
        """Open to the hand's open angles."""
        self.fingers.hold_here()
        for index in self.fingers.indices:
            self.fingers.go_to(index, self._settings.hand.open_angle[index])
        self._enter(Travelling(Mode.RELEASING))

    def grasp(self, force: float, is_streamed: bool = False) -> None:
        """Close until all fingers touch, then a mean tip force of ``force`` [N].

        A hand that grips already goes to that force and stays in its mode. ``is_streamed``: the
        force may change again before it is reached.
        """
        state = self.state
        if isinstance(state, Gripping):
            if isinstance(state, Pressing):
                state.order.is_streamed = is_streamed
            self.grip.retarget(force)
            self._change(state)
        elif isinstance(state, Approaching):
            self._enter(Approaching(Order(force, is_streamed, state.order.angle), state.touching))
        else:
            self.fingers.hold_here()
            self._enter(Approaching(Order(force, is_streamed)))

    def rotate(self, angle: float) -> None:
        """Turn the object to ``angle`` [rad]; while grasping, once the grip has settled."""
        state = self.state
        if isinstance(state, Approaching | Pressing):
            state.order.angle = angle
        elif isinstance(state, Gripping):
            self.grip.steer(self.fingers.pose.angle, angle)
            state.history.turn_end_reported = False
            self._enter(Turning(state.history))

    def hold(self, force: float | None = None, angle: float | None = None) -> float | None:
        """Take setpoints of a stream: a grip's ``force`` [N], the object's ``angle`` [rad].

        A hand that doesn't grip yet grasps first, with ``force``. The setpoints go there at
        `control.rotate_speed` and in `control.force_time`, smoothly whatever the stream. Return the
        angle that is turned to, bounded by what this grip reaches; None where none is known yet.
        """
        repeated = isinstance(self.state, Gripping) and force == self.grip.commanded
        if force is not None and not repeated:
            self.grasp(force, is_streamed=True)
        state = self.state
        if angle is None:
            return None
        if isinstance(state, Approaching | Pressing):
            state.order.angle = angle
        elif isinstance(state, Gripping):
            low, high = self.fingers.turning_range()
            angle = min(max(angle, low), high)
            self.grip.steer(self.fingers.pose.angle, angle)
            self._change(state)
            return angle
        return None

    def ease(self, most: float, seconds: float) -> None:
        """Let this grip come down to ``most`` [N] within ``seconds``, and press no more after."""
        if isinstance(self.state, Gripping):
            self.grip.ease(most, seconds)
            self._change(self.state)

    def set(self, compliance: float) -> None:
        """Set the angle by which the grip gives way to a torque [rad/(N·m)]."""
        self.grip.set_joint_stiffness(1.0 / compliance)

    def _change(self, state: Gripping) -> None:
        """Leave Settled if the force or the angle asked for differs from what it settled with."""
        grip, force, angle = self.grip, state.history.settled_force, state.history.settled_angle
        if isinstance(state, Settled) and not (
            abs(grip.commanded - force) < _FORCE_FLICKER * force
            and (math.isnan(grip.target_angle) or abs(grip.target_angle - angle) < _ANGLE_FLICKER)
        ):
            self._enter(Changing(state.history))

    # One tick

    def step(self, dt: float, goal: Goal) -> None:
        """Fill ``goal`` for this tick; ``goal.valid`` is False while torque is to be off."""
        goal.valid = self.torque
        goal.force = goal.angle = math.nan
        if not goal.valid:
            return
        current = self._current()  # of the state in which the tick begins
        if isinstance(self.state, Armed) and self.state.following:
            self.state.following -= 1
            self.fingers.hold_here()
        elif isinstance(self.state, Travelling):
            self._travel(self.state, dt)
        elif isinstance(self.state, Approaching):
            self._approach(self.state, dt)
        if isinstance(self.state, Gripping):  # also if it has begun at this tick
            self._hold(self.state, dt, goal)
        else:
            self.fingers.rest(goal, current)
        if isinstance(self.state, Gripping):
            goal.force, goal.angle = self.grip.target, self.grip.target_angle
        elif isinstance(self.state, Approaching):
            goal.force = self.state.order.force

    def hold_goal(self, goal: Goal) -> None:
        """Replace :meth:`step` while frames are late: goals stay as they are.

        A grip's goals are torques: its joints are damped, and a turn comes to rest.
        """
        if goal.valid and isinstance(self.state, Gripping) and self.state.history.loss is None:
            self.fingers.pull(goal, self.grip.hold_goal(self.fingers.reading))

    def _current(self) -> float:
        """Current [A] with which the joints follow their setpoints."""
        state, law = self.state, self._settings.control
        if isinstance(state, Armed):
            return state.current
        if not isinstance(state, Approaching):
            return self._settings.safety.current_move
        # A tip that meets the object before it is felt shall not press beyond the force wanted.
        pressed = 0.5 * state.order.force * self._settings.hand.finger_length * law.driving
        # A joint that stands under it, and whose tip feels nothing, has more friction than is set.
        pressed += max(law.joint_friction, float(self.fingers.grasp.free_torque.max()))
        return min(law.approach_current, pressed / law.torque_constant)

    def _travel(self, state: Travelling, dt: float) -> None:
        if not self.fingers.ramp(self._settings.control.move_speed):
            return
        state.arrived_for += dt
        off = self.fingers.distance
        if off < _ARRIVED:
            self._stay()
        elif state.arrived_for > _GRACE:
            text = f"{state.mode.value} ended {math.degrees(off):.1f}° short of its goal"
            self._warn("short", text)
            self._stay()

    def _approach(self, state: Approaching, dt: float) -> None:
        state.touching = self.fingers.close(state.touching)
        if len(state.touching) == len(self.fingers.indices):
            state.empty_for = self._empty_for(state.empty_for, dt)
            if not state.empty_for:
                self.grip.most = math.inf
                self.grip.start(self.fingers.force, state.order.force)
                self._enter(Pressing(GripHistory(), order=state.order))
        elif self.fingers.ramp(self._settings.control.approach_speed):
            state.arrived_for += dt
            if state.arrived_for > _GRACE:
                self._warn("grasp", "nothing to grasp within the joints' limits")
                self.fingers.hold_here()
                self._stay()

    def _empty_for(self, before: float, dt: float) -> float:
        """Return for how long [s] the tips seem to touch each other, and release when that lasts.

        Tips that press each other would roll off to one side. Their contacts are one, so that the
        object's width by joints and sensors is 0 up to their errors.
        """
        pose, width_min = self.fingers.pose, self._settings.object.width_min
        if not pose.valid or pose.width >= width_min:
            return 0.0
        if before + dt > _EMPTY:
            text = (
                f"nothing between the tips: {pose.width * 1e3:.1f} mm, "
                f"less than object.width_min {width_min * 1e3:g} mm; opening"
            )
            self._warn("grasp", text)
            self.release()
        return before + dt

    def _hold(self, state: Gripping, dt: float, goal: Goal) -> None:
        fingers, grip, history = self.fingers, self.grip, state.history
        if not fingers.in_contact:
            self._lose(history, dt, goal)
            return
        if history.loss is not None:  # the force is built up again: what moves joints is no load
            history.loss, state.reached_for = None, 0.0
            if isinstance(state, Settled):
                self._enter(state := Changing(history))
        is_settled = isinstance(state, Settled)
        fingers.pull(goal, grip.torques(fingers.reading, fingers.pose, is_settled))
        self._report_raise(history)
        if not is_settled:
            self._watch_settling(state, dt)
        history.empty_for = self._empty_for(history.empty_for, dt)

    def _lose(self, history: GripHistory, dt: float, goal: Goal) -> None:
        """Hold the joints where they are without a contact; end the grip when it stays away."""
        if history.loss is None:
            self.fingers.hold_here()
            # A board that went blind must not make the joints press harder than they did.
            pressed = max(goal.current[index] for index in self.fingers.indices)
            history.loss = ContactLoss(min(pressed, self._settings.safety.current_move))
        loss = history.loss
        self.fingers.rest(goal, loss.current)
        loss.lost_for += dt
        if loss.lost_for > _LOST:
            self._warn("lost", "contact lost; the joints hold where they are")
            self._enter(Armed(loss.current))

    def _watch_settling(self, state: Gripping, dt: float) -> None:
        """Pass into Settled once force and angle have stayed reached."""
        grip, pose, history = self.grip, self.fingers.pose, state.history
        is_reached = True
        if not isinstance(state, Pressing):
            self._end_turn_before_slip(history)
            is_reached = not abs(pose.angle - grip.target_angle) >= _ANGLE_REACHED  # also for NaN
        if not isinstance(state, Turning):
            streamed = isinstance(state, Pressing) and state.order.is_streamed
            near = abs(self.fingers.force - grip.target) < _NEAR * grip.target
            state.near_for = state.near_for + dt if near and not grip.shaking else 0.0
            stuck = state.near_for > _STUCK
            is_reached = is_reached and (stuck or self._is_force_reached(streamed))
        state.reached_for = state.reached_for + dt if is_reached else 0.0
        if state.reached_for <= _SETTLED:
            return
        if pose.valid and math.isnan(grip.target_angle) and not grip.upright:
            grip.steer(pose.angle, pose.angle)
        grip.begin_holding()
        history.settled_force, history.settled_angle = grip.commanded, grip.target_angle
        self._enter(Settled(history))
        if isinstance(state, Pressing) and (angle := state.order.angle) is not None:
            if refusal := self.fingers.why_not_turn(angle):
                self._warn("rotate", f"rotate: {refusal}")
            else:
                self.rotate(angle)

    def _is_force_reached(self, is_streamed: bool) -> bool:
        """Return True if the tips' mean force is at its target, or at a stream's setpoint near it.

        The mean, since what the object rubs on may take some force between the tips.
        """
        grip = self.grip
        wanted = grip.force.value if is_streamed else grip.target
        over = _FORCE_REACHED + min(self._settings.control.load_held, _HELD_OVER)
        off = self.fingers.force - wanted
        is_near = abs(wanted - grip.target) < _FOLLOWED * grip.target
        is_there = -_FORCE_REACHED * grip.target < off < over * grip.target
        return is_near and is_there and not grip.shaking

    def _end_turn_before_slip(self, history: GripHistory) -> None:
        """End a turn at the present angle where the tips would slip."""
        law, angle = self._settings.control, self.fingers.pose.angle
        shear_max = law.tip_friction * (1.0 - law.slip_margin)
        if self.fingers.grasp.shear * self.grip.turning_on > shear_max:
            if not history.turn_end_reported:
                text = f"turning ended at {math.degrees(angle):.1f}°: the tips would slip"
                self._warn("slip", text)
            history.turn_end_reported = True
            self.grip.steer(angle, angle)

    def _report_raise(self, history: GripHistory) -> None:
        """Report when the grip is raised against slip."""
        grip = self.grip
        if grip.slipped:
            self._warn("slip", "the object turns in the grip")
        if grip.target <= grip.commanded:
            history.raise_reported = False
        elif not history.raise_reported and grip.target > (1 + _FORCE_FLICKER) * grip.commanded:
            history.raise_reported = True
            why = "the object turns in it" if grip.slipped else "a load came at once"
            if grip.slip.guarded > 0.0:
                why = f"each tip may bear {grip.slip.guarded:.1f} N along its face"
            self._warn("slip", f"grip raised above {grip.commanded:.1f} N: {why}")
