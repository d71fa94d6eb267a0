"""Compute the joint torques of a grip from the tip forces and the object angle.

`control.grip_kernels` contains the computations. Two fingers can move in two ways. If both fingers
close, the grip force changes. If one finger closes and the other opens (q1 + δ, q2 − δ), the object
moves. Every control law therefore has two parts:

1. The *grip* part controls the force. The feed-forward torque is the product of moment arm and
   target force, plus the joint friction. A PI controller corrects the force error. The damping is
   matched to the tip stiffness.
2. The *steering* part controls the object angle. The steering part is the serial two-phased
   controller from the literature on soft fingertips. The integral of the angle error is added to
   the goal of one joint and subtracted from the goal of the other joint. A PD controller makes the
   joints follow their goals. The object rotates at φ̇ = r1 q̇1 − r2 q̇2
   (`GraspState.rolling_ratio`).

If ``control.law`` is ``"energy"``, the moment arms are computed from the gradient of the tips'
elastic energy. The contact table stores the elastic energy. The computation assumes that the tips
roll, so the moment arms include the effect of moments and shear forces at the tips.

If ``control.law`` is ``"upright"``, the control law ignores the object angle until a command sets a
target angle. The upright law applies equal torque and damping to both joints, as in the literature
on blind grasping. A virtual spring acts between the fingers (`hand.upright`). With the spring, the
elastic energy is lowest when the object is upright, even if the tips retain some shear.
Antisymmetric dither overcomes the joint friction until the object is upright. The control law then
holds the antisymmetric joint angle. After a command has set a target angle, each moment arm is the
distance from the pivot to the line of action of the force.
"""

from __future__ import annotations

import math

from softfinger.daemon.control import grip_kernels as kernels
from softfinger.daemon.control.grip_kernels import GripState
from softfinger.daemon.control.setpoint import Setpoint
from softfinger.daemon.control.slip_monitor import configure
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import ObjectPose, Reading


class Grip:
    """Controller for the grip force and the object angle."""

    def __init__(self, settings: Settings, fingers: list[int], grasp: GraspState) -> None:
        """Create the controller for ``fingers``, left first; ``grasp`` is read on each tick."""
        control = settings.control
        dt = 1.0 / settings.loop.rate
        self._control = control
        self._single_finger = None if len(fingers) == 2 else fingers[0]
        self._grasp = grasp
        self._state = state = GripState()
        self.force = Setpoint(dt, control.smooth_time, state.force)  # mean tip force [N]
        self.angle = Setpoint(dt, control.smooth_time, state.angle)  # object angle [rad]
        self.slip = state.slip
        self.commanded_max = math.inf  # upper limit of the commanded force [N]
        self.target_angle = math.nan  # target object angle [rad], NaN if no target is set
        configure(state.slip, settings)
        law = state.law
        law.dt = dt
        law.force_gain = control.force_gain
        law.force_bandwidth = 2.0 * math.pi * control.force_bandwidth
        law.rotate_bandwidth = 2.0 * math.pi * control.rotate_bandwidth
        law.rotate_speed = control.rotate_speed
        law.damping = 2.0 * control.damping_ratio * math.sqrt(control.joint_inertia)
        law.joint_friction, law.driving = control.joint_friction, control.driving
        law.torque_error = control.torque_error
        law.friction_speed = control.friction_speed
        law.turn_decay = math.exp(-2.0 * dt / control.smooth_time)
        law.is_blind = control.law == "upright"
        hand = settings.hand
        law.half_separation = 0.5 * hand.pivot_separation
        law.length, law.offset = hand.finger_length, hand.finger_offset
        law.radius = settings.tip.radius
        law.dither_torque, law.dither_time = control.dither_torque, control.dither_time
        law.dither_rate = 2.0 * math.pi * control.dither_frequency
        state.joint_stiffness = control.joint_stiffness

    @property
    def commanded(self) -> float:
        """Commanded force [N]."""
        return self._state.commanded

    @property
    def target(self) -> float:
        """Commanded force [N], increased if necessary to prevent slip."""
        return self.force.target

    @property
    def is_blind(self) -> bool:
        """True for the `upright` law, which uses the object angle only after a target is set."""
        return self._state.law.is_blind

    @property
    def angle_std(self) -> float:
        """Standard deviation of the estimated object angle [rad]."""
        return self._grasp.angle_std

    @property
    def is_dithering(self) -> bool:
        """True while dither moves the object upright, or while the dither has not started yet."""
        state = self._state
        awaited = state.law.is_blind and self._single_finger is None and not state.is_steering
        return awaited and state.dither_elapsed < state.law.dither_time

    @property
    def stopping_ratio(self) -> float:
        """Ratio of the angle at which a rotation that stops now would end, to the present angle.

        The ratio is 0 unless the angle setpoint is moving away from 0.
        """
        angle, speed = self.angle.value, self.angle.speed
        if speed * angle <= 0.0:
            return 0.0
        return 1.0 + min(speed * self._control.smooth_time / angle, 1.0)

    def start(self, measured: float, force: float) -> None:
        """Begin the grip at the ``measured`` force [N], then change the force to ``force`` [N]."""
        kernels.start(self._state.array, self._grasp.array, self.force.windows, measured)
        self.target_angle = math.nan
        self.retarget(force)

    def retarget(self, force: float) -> None:
        """Change the commanded force [N].

        If the commanded force decreases, the force required to prevent slip is reduced in
        proportion.
        """
        force = min(force, self.commanded_max)
        if force < self.commanded:
            self.slip.needed_force *= force / self.commanded
        self._state.commanded = force
        self._state.dither_elapsed = 0.0
        needed_force = min(self.slip.needed_force, self.slip.force_limit)
        self.force.target = max(force, needed_force)
        # Force increases against slip use the same rate, so a small change must not slow them down.
        change_min = max(0.1 * force, 0.5 * self._control.grip_raise_max)
        change = max(abs(force - self.force.value), change_min)
        self._state.force_rate = change / self._control.force_time

    def limit_force(self, force_max: float, duration: float) -> None:
        """Limit the force to ``force_max`` [N]; reduce a larger force within ``duration`` [s]."""
        self.commanded_max = force_max
        self.retarget(force_max)
        self._state.force_rate = abs(self.force.value - force_max) / duration

    def force_for_load(self) -> float:
        """Return the force [N] required for the load, including the slip margin and hidden load."""
        law, grasp = self.slip.law, self._grasp
        load = self.slip.assumed_load
        if not law.has_shear and law.object_load == 0.0:  # Joint friction may hide a load.
            load = max(load, law.joint_friction / max(grasp.load_arm, 0.5 * law.width))
        return max(load / self.slip.usable_friction, self.slip.needed_force)

    def steer(self, present: float, angle: float) -> None:
        """Rotate the object from its ``present`` angle to ``angle`` [rad] and hold it there."""
        if math.isnan(self.target_angle):
            self.angle.reset(present)
        self.target_angle = self.angle.target = angle
        self._state.is_steering = True

    def set_joint_stiffness(self, joint_stiffness: float) -> None:
        """Set the antisymmetric joint stiffness [N·m/rad] without a jump in the joint torques."""
        state, (q1, q2) = self._state, self._grasp.q
        present = 0.5 * (q1 - q2)
        ratio = state.joint_stiffness / joint_stiffness
        state.offset = present + (state.offset - present) * ratio
        state.joint_stiffness = joint_stiffness

    def begin_holding(self) -> None:
        """Mark the grip as settled so that loads can be detected."""
        kernels.begin_holding(self._state.array, self._grasp.array)

    def torques(self, reading: Reading, pose: ObjectPose, holding: bool) -> tuple[float, float]:
        """Return both joint torques [N·m]; positive torques close the fingers.

        The torque of an unused finger is 0. ``holding`` is True in a settled grip, in which only
        loads move the joints.
        """
        if self._single_finger is not None:
            return self._single_torque(reading, False)
        dq1, dq2 = reading.dq
        return kernels.grip_torques(
            self._state.array,
            self._grasp.array,
            self.force.windows,
            self.angle.windows,
            pose.angle if pose.valid else math.nan,
            (dq1, dq2),
            holding,
        )

    def hold_goal(self, reading: Reading) -> tuple[float, float]:
        """Return joint torques [N·m] that hold the force and stop a rotation if frames are late.

        Joint readings are still available, so damping and steering continue. With constant torques,
        the object would continue to rotate.
        """
        if self._single_finger is not None:
            return self._single_torque(reading, True)
        dq1, dq2 = reading.dq
        return kernels.hold_goal(self._state.array, self._grasp.array, (dq1, dq2))

    def _single_torque(self, reading: Reading, frames_late: bool) -> tuple[float, float]:
        finger = self._single_finger
        assert finger is not None
        grip, grasp, dq = self._state.array, self._grasp.array, reading.dq[finger]
        torque = kernels.single_torque(grip, grasp, self.force.windows, finger, dq, frames_late)
        return (torque, 0.0) if finger == 0 else (0.0, torque)
