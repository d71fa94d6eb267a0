"""The grip laws: forces and the object's angle to joint torques, once both tips touch.

`control.grip_kernels` computes them. Two fingers have one motion that changes the grip (both close)
and one that moves the object (q1 + δ, q2 − δ), so every law has two parts:

1. *grip*: a bias torque, lever times force wanted, with what the joints' friction takes on the way;
   a proportional and an integral part on the force felt; damping to the stiffness of the tips;
2. *steering*, the 'serial two-phased' law of the soft-fingertip literature: the object's angle
   error is integrated and fed antisymmetrically to the joints' goal, joint PD follows that goal.
   The object turns by φ̇ = turn1 q̇1 − turn2 q̇2, against the fingers' own sense.

With ``control.law = "energy"`` the levers are the gradient of the tables' energy along the rolling
increments, in which the tips' moments and shear forces are counted, too.

``upright`` doesn't use the object's angle until it is steered by a command. It gives both joints
one torque, with damping, as in the literature on blind grasping, and makes use of the tips' elastic
energy: it adds a spring between the fingers that puts the energy's minimum where the object stands
upright, whatever shear is stuck in the tips (`hand.upright`), and shakes the fingers against each
other until nothing but the minimum holds the object. Then it keeps the fingers' lean. Steered, it
takes the force's arm about the pivot as its lever.
"""

from __future__ import annotations

import math

from softfinger.daemon.control import grip_kernels as kernels
from softfinger.daemon.control.grip_kernels import GripState
from softfinger.daemon.control.setpoint import Setpoint
from softfinger.daemon.control.slip_monitor import set_law
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import ObjectPose, Reading


class Grip:
    """Force control from the tactile estimate, and steering by the antisymmetric joint motion."""

    def __init__(self, settings: Settings, fingers: list[int], grasp: GraspState) -> None:
        """``fingers`` take part, left first; ``grasp`` is read at each tick."""
        control = settings.control
        dt = 1.0 / settings.loop.rate
        self._control = control
        self._alone = None if len(fingers) == 2 else fingers[0]
        self._grasp = grasp
        self._state = state = GripState()
        self.force = Setpoint(dt, control.smooth_time, state.force)  # mean of the tips [N]
        self.angle = Setpoint(dt, control.smooth_time, state.angle)  # of the object [rad]
        self.slip = state.slip
        self.commanded = 0.0  # force of the command [N]
        self.most = math.inf  # that it is eased to, whatever is commanded [N]
        self.target = 0.0  # target force, more where the tips would slip [N]
        self.slipped = False  # the object has turned in the grip, at this tick
        self.target_angle = math.nan  # target of the object's angle [rad]; NaN: it is not steered
        set_law(state.slip.law, settings)
        law = state.law
        law.dt = dt
        law.force_gain = control.force_gain
        law.force_bandwidth = 2.0 * math.pi * control.force_bandwidth
        law.rotate_bandwidth = 2.0 * math.pi * control.rotate_bandwidth
        law.rotate_speed = control.rotate_speed
        law.damping = 2.0 * control.damping_ratio * math.sqrt(control.joint_inertia)
        law.friction, law.driving = control.joint_friction, control.driving
        law.torque_error = control.torque_error
        law.friction_speed = control.friction_speed
        law.torque_max = settings.safety.current_max * control.torque_constant
        law.decay = math.exp(-2.0 * dt / control.smooth_time)
        law.upright = control.law == "upright"
        hand = settings.hand
        law.half_separation = 0.5 * hand.pivot_separation
        law.length, law.offset = hand.finger_length, hand.finger_offset
        law.radius = settings.tip.radius
        law.dither_torque, law.dither_time = control.dither_torque, control.dither_time
        law.dither_rate = 2.0 * math.pi * control.dither_frequency
        state.joint_stiffness = control.joint_stiffness

    @property
    def upright(self) -> bool:
        """True if a grip takes no account of the object's angle."""
        return self._state.law.upright

    @property
    def shaking(self) -> bool:
        """True while the fingers are still to bring the object upright."""
        state = self._state
        awaited = state.law.upright and self._alone is None and not state.steering
        return awaited and state.dither_elapsed < state.law.dither_time

    @property
    def turning_on(self) -> float:
        """The angle at which turning could stop, over the present one; 0 while it goes upright."""
        angle, speed = self.angle.value, self.angle.speed
        if speed * angle <= 0.0:
            return 0.0
        return 1.0 + min(speed * self._control.smooth_time / angle, 1.0)

    @property
    def turning(self) -> bool:
        """True while the setpoint of the object's angle is on its way."""
        return self._state.steering and self.angle.value != self.target_angle

    def start(self, felt: float, force: float) -> None:
        """Take over from the approach with ``felt`` N on the tips, and go to ``force`` [N]."""
        kernels.start(self._state.array, self._grasp.array, self.force.windows, felt)
        self.target_angle = math.nan
        self.retarget(force)

    def retarget(self, force: float) -> None:
        """Go to another grip force [N]; what a firmer one needed more is less of a weaker one."""
        force = min(force, self.most)
        if force < self.commanded:
            self.slip.needed *= force / self.commanded
        self.commanded = self._state.commanded = force
        self._state.dither_elapsed = 0.0
        self.target = self.force.target = max(force, min(self.slip.needed, self.slip.force_limit))
        change_min = max(0.1 * force, 0.5 * self._control.grip_raise_max)
        change = max(abs(force - self.force.value), change_min)
        self._state.force_rate = change / self._control.force_time

    def ease(self, most: float, seconds: float) -> None:
        """Press with ``most`` [N] at most from now on, come to within ``seconds``."""
        self.most = most
        self.retarget(most)
        self._state.force_rate = abs(self.force.value - most) / seconds

    def load_needs(self) -> float:
        """Return the force [N] that the load needs with its margin, what may be hidden included."""
        law, grasp = self.slip.law, self._grasp
        load = self.slip.guarded
        if not law.has_shear and law.object_load == 0.0:  # nothing says that there is none
            load = max(load, law.joint_friction / max(grasp.load_arm, 0.5 * law.width))
        spare = law.friction * (1.0 - law.margin) - grasp.shear
        return max(load / max(spare, 0.3 * law.friction), self.slip.needed)

    def steer(self, present: float, angle: float) -> None:
        """Turn the object from its ``present`` angle to ``angle`` [rad], and keep it there."""
        if math.isnan(self.target_angle):
            self.angle.reset(present)
        self.target_angle = self.angle.target = angle
        self._state.steering = True

    def set_joint_stiffness(self, joint_stiffness: float) -> None:
        """Keep the joints to their lean with so many N·m/rad; torques go on as they are."""
        state, (q1, q2) = self._state, self._grasp.q
        lean = 0.5 * (q1 - q2)
        state.offset = lean + (state.offset - lean) * state.joint_stiffness / joint_stiffness
        state.joint_stiffness = joint_stiffness

    def begin_holding(self) -> None:
        """Mark the grip as settled: from now on loads from outside show."""
        kernels.begin_holding(self._state.array, self._grasp.array)

    def torques(self, reading: Reading, pose: ObjectPose, holding: bool) -> tuple[float, float]:
        """Return joint torques [N·m], positive closing; a finger that takes no part gets 0.

        ``holding``: nothing but loads moves the joints.
        """
        if self._alone is not None:
            return self._torque_alone(reading, False)
        dq1, dq2 = reading.dq
        torque1, torque2, self.target, self.slipped = kernels.grip_torques(
            self._state.array,
            self._grasp.array,
            self.force.windows,
            self.angle.windows,
            pose.angle if pose.valid else math.nan,
            (dq1, dq2),
            holding,
        )
        return torque1, torque2

    def hold_goal(self, reading: Reading) -> tuple[float, float]:
        """Return joint torques [N·m] while frames are late: the force stays, turning ends.

        Joints are read all the same. Torques that stayed as they are would turn the object on, to
        the end of what damps and steers it.
        """
        if self._alone is not None:
            return self._torque_alone(reading, True)
        dq1, dq2 = reading.dq
        return kernels.hold_goal(self._state.array, self._grasp.array, (dq1, dq2))

    def _torque_alone(self, reading: Reading, frames_late: bool) -> tuple[float, float]:
        finger = self._alone
        assert finger is not None
        grip, grasp, dq = self._state.array, self._grasp.array, reading.dq[finger]
        torque = kernels.single_torque(grip, grasp, self.force.windows, finger, dq, frames_late)
        return (torque, 0.0) if finger == 0 else (0.0, torque)
