"""Run the state machine that handles the hand's commands and sets the servo goal on each tick.

State        Mode       Action                           Event → next state
-----------  ---------  -------------------------------  ------------------------------------------
Off          DISARMED   torque is off                    `arm` → Armed
             FAULT      torque is off                    `clear` → Off (DISARMED)
Armed        ARMED      joints hold their positions      `move` → Travelling (MOVING);
                                                         `grasp`, `hold` → Approaching
Travelling   MOVING     joints move to commanded angles  arrived, or timed out → Armed;
                                                         `grasp`, `hold` → Approaching
             RELEASING  joints move to the open angles   arrived, or timed out → Armed
Approaching  GRASPING   fingers close; the first one to  all touch → Pressing; at the joint limits
                        touch waits for the other        for _STUCK_TIME → Armed
Pressing     GRASPING   the force increases              force reached → Settled, then Turning if
                                                         an angle was commanded
Settled      HOLDING    force and angle are constant:    `grasp`, `hold`, `limit_force` with
                        only loads move the joints       another value, contact regained
                                                         → Changing
Changing     HOLDING    force or angle changes           force and angle reached → Settled
Turning      ROTATING   the object rotates               angle reached → Settled

Several states share these transitions:

- In every state, a fault leads to Off (FAULT). `stop` and `disarm` lead to Off (DISARMED), but a
  fault persists until `clear`.
- In every state with torque, `release` leads to Travelling (RELEASING).
- In Settled, Changing and Turning, `rotate` leads to Turning.
- In the states from Approaching to Turning, the hand enters Travelling (RELEASING) if the tips
  touch each other for `safety.frame_age_hold` frame periods.
- In the states from Pressing to Turning, the joints hold their positions while a contact is
  missing. If the contact is missing for `safety.frame_age_fault` frame periods, the hand enters
  Armed.

Each transition creates a new instance of a state class. Timers and flags are attributes of the
state, so they are discarded when the state ends. `control.modes` lists the commands for each mode,
and `loop.requests` checks each command. `control.fingers` drives the joints, `control.grip`
computes the joint torques, and `safety.safety` limits the goals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from softfinger.daemon.control.fingers import Fingers
from softfinger.daemon.control.grip import Grip
from softfinger.daemon.control.grip_kernels import ANGLE_TOLERANCE
from softfinger.daemon.control.modes import Mode
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.hand_state import GATE
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Event, Goal, State

# A joint has arrived if it is within this distance of its goal [rad]. The distance is five times
# the position error that joint friction causes with the default settings.
_ARRIVAL_DISTANCE = 0.03
# Force tolerance as a fraction of the force target. With simulated sensors, the force noise is 0.3
# to 0.6 % (1 σ). A smaller change in a streamed force or a smaller force increase counts as noise.
_FORCE_TOLERANCE = 0.03
# Force error that joint or gear friction may cause, as a fraction of the force target. With the
# default finger, a friction torque of 0.05 N·m causes an error of 10 % at a force of 6 N. The
# integral term removes the friction error within seconds. A streamed target may never stop
# changing. For a streamed force, it is sufficient that the force follows the setpoint and that the
# setpoint is within this tolerance of the target.
_FRICTION_TOLERANCE = 0.1
# Time [s] after which a joint that has not reached its goal counts as stuck. After the same time, a
# force within _FRICTION_TOLERANCE of its target counts as reached. _STUCK_TIME is ten times the
# settling time of the force in a hand without friction.
_STUCK_TIME = 2.0
# Largest change in a streamed angle that counts as noise [rad]. After a larger change, the joints
# move, and the slip monitor could not distinguish this motion from the effect of a load.
_ANGLE_NOISE = 2e-3


class ControlState:
    """Base class of the hand's states."""

    mode: Mode


@dataclass
class Off(ControlState):
    """Torque is off. The mode is DISARMED, or FAULT until the fault is cleared."""

    mode: Mode = Mode.DISARMED


@dataclass
class Armed(ControlState):
    """The joints hold their positions."""

    mode = Mode.ARMED
    current: float  # current limit [A]
    following_count: int = 0  # number of remaining ticks on which the setpoints follow the joints


@dataclass
class Travelling(ControlState):
    """The joints move to their setpoint targets, in mode MOVING or RELEASING."""

    mode: Mode
    arrived_for: float = 0.0  # time since the setpoints reached their targets [s]


@dataclass
class GraspCommand:
    """Force and angle commanded for a grasp, stored until the grasp has settled."""

    force: float  # [N]
    is_streamed: bool  # True if the client streams the force
    angle: float | None = None  # target angle after the grasp has settled [rad]
    limits_angle: bool = False  # True if `hold` set the angle, which is limited to the grip's range


@dataclass
class Approaching(ControlState):
    """The fingers close until all of them are in contact."""

    mode = Mode.GRASPING
    command: GraspCommand
    touching: set[int] = field(default_factory=set)  # indices of the fingers in contact
    arrived_for: float = 0.0  # time since the setpoints reached the joint limits [s]
    empty_for: float = 0.0  # duration of apparent contact between the tips [s]


@dataclass
class GripHistory:
    """Data that all states of one grip share; a grip begins when all fingers are in contact."""

    lost_for: float = 0.0  # [s]
    lost_current: float = 0.0  # current limit while a contact is missing [A]
    empty_for: float = 0.0  # duration of apparent contact between the tips [s]
    settled_force: float = math.nan  # commanded force when the grip last settled [N]
    settled_angle: float = math.nan  # commanded angle when the grip last settled [rad]
    increase_reported: bool = False
    turn_end_reported: bool = False


@dataclass
class Gripping(ControlState):
    """Base class of the states in which the grip controller computes joint torques."""

    history: GripHistory
    reached_for: float = 0.0  # time since force and angle reached their targets [s]
    near_for: float = 0.0  # time since the force error fell below _FRICTION_TOLERANCE [s]


@dataclass(kw_only=True)
class Pressing(Gripping):
    """The force increases to its target."""

    mode = Mode.GRASPING
    command: GraspCommand


class Settled(Gripping):
    """Force and angle are constant, so only loads move the joints."""

    mode = Mode.HOLDING


class Changing(Gripping):
    """The force or the angle approaches a new target."""

    mode = Mode.HOLDING


class Turning(Gripping):
    """The object rotates."""

    mode = Mode.ROTATING


class Control:
    """State machine that executes the hand's commands. Only the loop thread may use this class."""

    def __init__(self, settings: Settings, state: State, grasp: GraspState) -> None:
        """Create the machine; ``state`` and ``grasp`` are read on each tick but never written."""
        self._settings = settings
        self.fingers = Fingers(settings, state, grasp)
        self.grip = Grip(settings, self.fingers.indices, grasp)
        self.state: ControlState = Off()
        self.events: list[Event] = []
        # Maximum duration of a contact loss [s], equal to the maximum time without frames.
        self._contact_loss_time = settings.safety.frame_age_fault / settings.tactile.rate
        # A grip counts as empty if the tips have appeared to touch each other for this long [s].
        self._empty_time = settings.safety.frame_age_hold / settings.tactile.rate
        # Settling time [s]. Force and angle count as settled when they have stayed at their targets
        # for this time. A setpoint moves on for 1.5 `control.smooth_time` after its target has
        # stopped, because the setpoint is averaged twice.
        self._settling_time = 2.0 * settings.control.smooth_time

    @property
    def mode(self) -> Mode:
        """Mode of the hand."""
        return self.state.mode

    @property
    def torque(self) -> bool:
        """True if servo torque must be on."""
        return not isinstance(self.state, Off)

    def _enter(self, state: ControlState) -> None:
        last, self.state = self.state, state
        if state.mode is not last.mode:
            self.events.append(("info", "mode", f"{last.mode.value} → {state.mode.value}"))
        waits = isinstance(last, Approaching | Pressing) and last.command.angle is not None
        if waits and not isinstance(state, Approaching | Gripping):
            self._warn(
                "rotate", f"rotate: discarded because the grasp ended in mode {state.mode.value}"
            )

    def _enter_armed(self) -> None:
        self._enter(Armed(self._settings.safety.current_move))

    def _warn(self, kind: str, text: str) -> None:
        self.events.append(("warning", kind, text))

    # Commands

    def fail(self, reason: str, name: str) -> None:
        """Latch a fault; torque stays off until the ``clear`` command.

        ``name`` is the name of the violated limit in `safety.limits`.
        """
        self._enter(Off(Mode.FAULT))
        self.events.append(("error", name, reason))

    def arm(self) -> None:
        """Switch torque on and hold the joints at their current positions."""
        # The servos switch torque on at the end of the first tick, so the joints may still move
        # until the second tick.
        self._enter(Armed(self._settings.safety.current_move, following_count=2))

    def disarm(self) -> None:
        """Switch torque off and clear any fault."""
        self._enter(Off())

    def stop(self) -> None:
        """Switch torque off; a fault stays latched."""
        if self.mode is not Mode.FAULT:
            self._enter(Off())

    def move(self, **angles: float) -> None:
        """Move the ``left`` joint, the ``right`` joint or both joints to the given angles [rad]."""
        if self.mode is not Mode.MOVING:
            self.fingers.hold_here()
        for name, q in angles.items():
            self.fingers.set_target(FINGERS.index(name), q)
        self._enter(Travelling(Mode.MOVING))

    def release(self) -> None:
        """Open the fingers to ``hand.open_angle``."""
        self.fingers.hold_here()
        for index in self.fingers.indices:
            self.fingers.set_target(index, self._settings.hand.open_angle[index])
        self._enter(Travelling(Mode.RELEASING))

    def grasp(self, force: float, is_streamed: bool = False) -> None:
        """Close the fingers onto the object, then increase the mean tip force to ``force`` [N].

        If the hand is already gripping, only the force changes and the mode stays the same. Set
        ``is_streamed`` if a client streams setpoints. A streamed force may change before the grip
        reaches the force.
        """
        state = self.state
        if isinstance(state, Gripping):
            if isinstance(state, Pressing):
                state.command.is_streamed = is_streamed
            self.grip.retarget(force)
            self._change(state)
        elif isinstance(state, Approaching):
            # Keep the timers, because a client may stream setpoints.
            state.command.force, state.command.is_streamed = force, is_streamed
        else:
            self.fingers.hold_here()
            self._enter(Approaching(GraspCommand(force, is_streamed)))

    def rotate(self, angle: float) -> None:
        """Rotate the object to ``angle`` [rad]; during a grasp, wait until the grip has settled."""
        state = self.state
        if isinstance(state, Approaching | Pressing):
            state.command.angle, state.command.limits_angle = angle, False
        elif isinstance(state, Gripping):
            self.grip.steer(self.fingers.pose.angle, angle)
            state.history.turn_end_reported = False
            self._enter(Turning(state.history))

    def hold(self, force: float | None = None, angle: float | None = None) -> float | None:
        """Follow streamed setpoints for the grip ``force`` [N] and the object ``angle`` [rad].

        If the hand is not gripping yet, it first grasps with ``force``. The angle setpoint moves
        smoothly at `control.rotate_speed`, and the force setpoint reaches its target within
        `control.force_time`.

        Returns
        -------
        float | None
            Target angle, limited to the range of this grip; None if no target has been set yet.
        """
        if force is not None:
            same = min(force, self.grip.commanded_max) == self.grip.commanded
            if not (same and isinstance(self.state, Gripping)):
                self.grasp(force, is_streamed=True)
        state = self.state
        if angle is None:
            return None
        if isinstance(state, Approaching | Pressing):
            state.command.angle, state.command.limits_angle = angle, True
        elif isinstance(state, Gripping):
            angle = self.fingers.limited_angle(angle)
            self.grip.steer(self.fingers.pose.angle, angle)
            self._change(state)
            return angle
        return None

    def limit_force(self, force_max: float, duration: float) -> None:
        """Limit the force to ``force_max`` [N]; reduce a larger force within ``duration`` [s]."""
        if isinstance(self.state, Gripping):
            self.grip.limit_force(force_max, duration)
            self._change(self.state)

    def set(self, compliance: float) -> None:
        """Set the grip's rotational compliance [rad/(N·m)]."""
        self.grip.set_joint_stiffness(1.0 / compliance)

    def _change(self, state: Gripping) -> None:
        """Leave the Settled state if the commanded force or angle has changed significantly.

        Any force command restarts the dither of the upright law, which also moves the joints.
        """
        grip, force, angle = self.grip, state.history.settled_force, state.history.settled_angle
        change, off = abs(grip.commanded - force), abs(grip.target_angle - angle)
        same_force = change < _FORCE_TOLERANCE * force and not grip.is_dithering
        same_angle = math.isnan(grip.target_angle) or off < _ANGLE_NOISE
        if isinstance(state, Settled) and not (same_force and same_angle):
            self._enter(Changing(state.history))

    # One tick

    def step(self, dt: float, goal: Goal) -> None:
        """Set ``goal`` for this tick; ``goal.valid`` is False while torque must be off."""
        goal.valid = self.torque
        goal.force = goal.angle = math.nan
        if not goal.valid:
            return
        current = self._current()  # current limit of the state before any transition on this tick
        if isinstance(self.state, Armed) and self.state.following_count:
            self.state.following_count -= 1
            self.fingers.hold_here()
        elif isinstance(self.state, Travelling):
            self._travel(self.state, dt)
        elif isinstance(self.state, Approaching):
            self._approach(self.state, dt)
        if isinstance(self.state, Gripping):  # The grip may have begun on this tick.
            self._step_grip(self.state, dt, goal)
        else:
            self.fingers.follow_setpoints(goal, current)
        if isinstance(self.state, Gripping):
            goal.force, goal.angle = self.grip.target, self.grip.target_angle
        elif isinstance(self.state, Approaching):
            goal.force = self.state.command.force

    def hold_goal(self, goal: Goal) -> None:
        """Set the goals while frames are late. Call this method instead of :meth:`step`.

        Outside a grip, the position goals stay the same. In a grip, the torque goals damp the
        joints and stop any rotation.
        """
        if goal.valid and isinstance(self.state, Gripping) and not self.state.history.lost_for:
            self.fingers.apply_torques(goal, self.grip.hold_goal(self.fingers.reading))

    def _current(self) -> float:
        """Return the motor current limit [A] for joints that follow their setpoints."""
        state, law = self.state, self._settings.control
        if isinstance(state, Armed):
            return state.current
        if not isinstance(state, Approaching):
            return self._settings.safety.current_move
        # The tip may reach the object before the sensor detects contact. Limit the current so that
        # the tip force stays well below the commanded force.
        pressed = 0.5 * state.command.force * self._settings.hand.finger_length * law.driving
        # The joint friction may exceed the setting. Therefore, also allow for `free_torque`, the
        # friction torque measured in free motion. Otherwise, the joint might not move at the
        # limited current.
        pressed += max(law.joint_friction, float(self.fingers.grasp.free_torque.max()))
        return min(law.approach_current, pressed / law.torque_constant)

    def _travel(self, state: Travelling, dt: float) -> None:
        if not self.fingers.advance_setpoints(self._settings.control.move_speed):
            return
        state.arrived_for += dt
        off = self.fingers.distance_max
        if off < _ARRIVAL_DISTANCE:
            self._enter_armed()
        elif state.arrived_for > _STUCK_TIME:
            text = f"{state.mode.value}: stopped {math.degrees(off):.1f}° before the goal"
            self._warn("short", text)
            self.fingers.hold_here()
            self._enter_armed()

    def _approach(self, state: Approaching, dt: float) -> None:
        state.touching = self.fingers.close_fingers(state.touching)
        if len(state.touching) == len(self.fingers.indices):
            state.empty_for = self._empty_for(state.empty_for, dt)
            if not state.empty_for:
                self.grip.commanded_max = math.inf
                self.grip.start(self.fingers.force, state.command.force)
                self._enter(Pressing(GripHistory(), command=state.command))
        elif self.fingers.advance_setpoints(self._settings.control.approach_speed):
            state.arrived_for += dt
            if state.arrived_for > _STUCK_TIME:
                off = self.fingers.distance_max
                where = "at" if off < _ARRIVAL_DISTANCE else f"{math.degrees(off):.1f}° before"
                self._warn("grasp", f"the fingers found no object and stopped {where} their limits")
                self.fingers.hold_here()
                self._enter_armed()

    def _empty_for(self, before: float, dt: float) -> float:
        """Return the duration [s] of apparent contact between the tips.

        The fingers open after `_empty_time`, because tips that press against each other would roll
        off to one side. When the tips touch each other, both sensors measure the same contact. The
        estimated object width is then 0 to within its standard error.
        """
        pose, width_min = self.fingers.pose, self._settings.object.width_min
        if not pose.valid or pose.width >= width_min:
            return 0.0
        if before + dt > self._empty_time:
            text = (
                f"no object between the tips: their distance is {pose.width * 1e3:.1f} mm, "
                f"expected at least object.width_min = {width_min * 1e3:g} mm; the hand opens"
            )
            self._warn("grasp", text)
            self.release()
        return before + dt

    def _step_grip(self, state: Gripping, dt: float, goal: Goal) -> None:
        fingers, grip, history = self.fingers, self.grip, state.history
        if not fingers.in_contact:
            self._handle_contact_loss(history, dt, goal)
            return
        if history.lost_for:
            # While the force increases again, joint motion does not indicate a load.
            history.lost_for = state.reached_for = 0.0
            if isinstance(state, Settled):
                self._enter(state := Changing(history))
        is_settled = isinstance(state, Settled)
        fingers.apply_torques(goal, grip.torques(fingers.reading, fingers.pose, is_settled))
        self._report_increase(history)
        if not is_settled:
            self._check_settled(state, dt)
        history.empty_for = self._empty_for(history.empty_for, dt)

    def _handle_contact_loss(self, history: GripHistory, dt: float, goal: Goal) -> None:
        """Hold the joints while a contact is missing; after a time limit, end the grip."""
        if not history.lost_for:
            self.fingers.hold_here()
            # A sensor failure must not cause the joints to press harder.
            pressed = max(goal.current[index] for index in self.fingers.indices)
            history.lost_current = min(pressed, self._settings.safety.current_move)
        self.fingers.follow_setpoints(goal, history.lost_current)
        history.lost_for += dt
        if history.lost_for > self._contact_loss_time:
            self._warn("lost", "contact was lost; the joints hold their positions")
            self._enter(Armed(history.lost_current))

    def _check_settled(self, state: Gripping, dt: float) -> None:
        """Enter the Settled state when force and angle have stayed at their targets long enough."""
        grip, pose, history = self.grip, self.fingers.pose, state.history
        is_reached = True
        if not isinstance(state, Pressing):
            self._end_turn_before_slip(history)
            # The controller ignores angle errors within the noise of the estimate.
            tolerance = max(ANGLE_TOLERANCE, GATE * grip.angle_std)
            is_reached = not abs(pose.angle - grip.target_angle) > tolerance  # True for NaN
        if not isinstance(state, Turning):
            streamed = isinstance(state, Pressing) and state.command.is_streamed
            near = abs(self.fingers.force - grip.target) < _FRICTION_TOLERANCE * grip.target
            state.near_for = state.near_for + dt if near and not grip.is_dithering else 0.0
            stuck = state.near_for > _STUCK_TIME
            is_reached = is_reached and (stuck or self._is_force_reached(streamed))
        state.reached_for = state.reached_for + dt if is_reached else 0.0
        if state.reached_for <= self._settling_time:
            return
        if pose.valid and math.isnan(grip.target_angle) and not grip.is_blind:
            grip.steer(pose.angle, pose.angle)
        grip.begin_holding()
        history.settled_force, history.settled_angle = grip.commanded, grip.target_angle
        self._enter(Settled(history))
        if isinstance(state, Pressing) and (angle := state.command.angle) is not None:
            if state.command.limits_angle:
                angle = self.fingers.limited_angle(angle)
            if refusal := self.fingers.turn_refusal(angle):
                self._warn("rotate", f"rotate: {refusal}")
            else:
                self.rotate(angle)

    def _is_force_reached(self, is_streamed: bool) -> bool:
        """Return True if the mean tip force has reached its target or a setpoint near the target.

        The mean is used because friction between the object and its support can make the tip forces
        unequal.
        """
        grip = self.grip
        wanted = grip.force.value if is_streamed else grip.target
        over = _FORCE_TOLERANCE + min(self._settings.control.load_held, _FRICTION_TOLERANCE)
        off = self.fingers.force - wanted
        is_near = abs(wanted - grip.target) < _FRICTION_TOLERANCE * grip.target
        is_there = -_FORCE_TOLERANCE * grip.target < off < over * grip.target
        return is_near and is_there and not grip.is_dithering

    def _end_turn_before_slip(self, history: GripHistory) -> None:
        """End a rotation at the current angle if the tips would slip at a larger angle."""
        law, angle = self._settings.control, self.fingers.pose.angle
        shear_max = law.tip_friction * (1.0 - law.slip_margin)
        if self.fingers.grasp.shear * self.grip.stopping_ratio > shear_max:
            if not history.turn_end_reported:
                text = (
                    f"rotation stopped at {math.degrees(angle):.1f}° because the tips would "
                    "slip beyond this angle"
                )
                self._warn("slip", text)
            history.turn_end_reported = True
            self.grip.steer(angle, angle)

    def _report_increase(self, history: GripHistory) -> None:
        """Report slip, and report the start of each force increase."""
        grip = self.grip
        if grip.slip.has_turned:
            self._warn("slip", "the object is rotating in the grip")
        margin = _FORCE_TOLERANCE * grip.commanded
        if grip.target <= grip.commanded:
            history.increase_reported = False
        elif not history.increase_reported and grip.target > grip.commanded + margin:
            history.increase_reported = True
            why = "the object rotates" if grip.slip.has_turned else "sudden load"
            if not grip.slip.reflex_triggered:
                why = (
                    f"the load may reach {grip.slip.assumed_load:.1f} N along the object's face "
                    "at each tip"
                )
            text = f"grip force increased above the commanded {grip.commanded:.1f} N: {why}"
            self._warn("slip", text)
