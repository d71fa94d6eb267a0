"""The grip laws: forces and the object's angle to joint torques, once both tips touch.

What it computes each tick stands in `control.grip_kernels`; modes and limits are elsewhere. Two
fingers have one motion that changes the grip (both close) and one that moves the object (q1 + δ, q2
− δ), so every law has two parts:

1. *grip*: a bias torque, lever times force wanted, with what the joints' friction takes on the way;
   a proportional and an integral part on the force felt; damping to the stiffness of the tips;
2. *steering*, the 'serial two-phased' law of the soft-fingertip literature: the object's angle
   error is integrated and fed antisymmetrically to the joints' goal, joint PD follows that goal.
   The object turns by φ̇ = turn1 q̇1 − turn2 q̇2, against the fingers' own sense.

``control.law`` says where the levers come from: ``two_phase`` takes the force's arm about the
pivot, ``energy`` the gradient of the tables' energy along the rolling increments, in which the
tips' moments and shear forces are counted, too. ``position`` commands angles and no torques; it is
there to be compared with.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.daemon.control import grip_kernels as law
from softfinger.daemon.control.setpoint import Reference
from softfinger.daemon.control.slip_monitor import SlipWatch
from softfinger.daemon.perception.contact_filter import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Contact, ObjectPose, Reading


class Grip:
    """Force control from the tactile estimate, and steering by the antisymmetric joint motion."""

    def __init__(self, settings: Settings, fingers: list[int]) -> None:
        """``fingers`` take part, left first."""
        self._control = control = settings.control
        self._fingers = fingers
        both = len(fingers) == 2
        dt = 1.0 / settings.loop.rate
        # Joints that are held to angles give whatever torque that takes: it tells no load.
        self._watches = control.law != "position" and both
        self.force = Reference(dt, control.smooth_time)
        self.angle = Reference(dt, control.smooth_time)
        self.holding = False  # nothing but loads moves the joints
        self.slip = SlipWatch(settings)
        self.force_target = 0.0  # N that was asked for
        self._steering = False
        g = self._memory = np.zeros(law.MEMORY)
        g[law.DT] = dt
        g[law.FORCE_GAIN] = control.force_gain
        g[law.FORCE_BANDWIDTH] = 2.0 * math.pi * control.force_bandwidth
        g[law.ROTATE_BANDWIDTH] = 2.0 * math.pi * control.rotate_bandwidth
        g[law.ROTATE_SPEED] = control.rotate_speed
        g[law.DAMPING] = 2.0 * control.damping_ratio * math.sqrt(control.joint_inertia)
        g[law.FRICTION] = control.joint_friction
        g[law.FRICTION_SPEED] = control.friction_speed
        g[law.TORQUE_MAX] = settings.safety.current_max * control.torque_constant
        g[law.BY_ENERGY] = float(control.law == "energy" and both)
        g[law.REST] = math.exp(-2.0 * dt / control.smooth_time)
        g[law.JOINT_STIFFNESS] = control.joint_stiffness

    @property
    def steering(self) -> bool:
        """The object's angle is gone to, or kept."""
        return self._steering

    @property
    def angle_target(self) -> float:
        """The object's angle that is gone to [rad]."""
        return self.angle.target

    @property
    def turning_on(self) -> float:
        """The angle at which turning could stop, over the present one; 0 while it goes upright."""
        angle, speed = self.angle.value, self.angle.speed
        if speed * angle <= 0.0:
            return 0.0
        return 1.0 + min(speed * self._control.smooth_time / angle, 1.0)

    def start(self, held: GraspState, felt: float, force: float) -> None:
        """Take over from the approach with ``felt`` N on the tips."""
        self.slip.forget()
        self.force.reset(felt)
        q1, q2 = held.q
        g = self._memory
        g[law.INTEGRAL] = g[law.SHIFT] = g[law.CLOSING_FRICTION] = 0.0
        g[law.OFFSET] = 0.5 * (q1 - q2)
        g[law.CLOSED] = 0.5 * (q1 + q2)
        self._steer_on(False)
        self.retarget(force)

    def retarget(self, force: float) -> None:
        """Go to another grip force [N]."""
        self.force_target = force
        self.force.target = self.slip.kept(force)
        least = max(0.1 * force, 0.5 * self._control.grip_raise_max)
        way = max(abs(force - self.force.value), least)
        self._memory[law.FORCE_RATE] = way / self._control.force_time

    def steer(self, present: float, angle: float) -> None:
        """Turn the object from its ``present`` angle to ``angle`` [rad], and keep it there."""
        if not self._steering:
            self.angle.reset(present)
        self.angle.target = angle
        self._steer_on(True)

    def soften(self, joint_stiffness: float) -> None:
        """Keep the joints to their lean with so many N·m/rad."""
        self._memory[law.JOINT_STIFFNESS] = joint_stiffness

    def _steer_on(self, on: bool) -> None:
        self._steering = on
        self._memory[law.STEERING] = float(on)

    def torques(
        self, reading: Reading, contacts: list[Contact], pose: ObjectPose, held: GraspState
    ) -> tuple[float, float]:
        """Joint torques [N·m], positive closing; a finger that takes no part gets 0."""
        if len(self._fingers) == 1:
            finger = self._fingers[0]
            torque = law.press(
                self._memory,
                self.force.memory,
                held.told,
                finger,
                contacts[finger].force,
                reading.dq[finger],
            )
            return (torque, 0.0) if finger == 0 else (0.0, torque)
        if self._watches:
            self._keep_margin(contacts, held)
        left, right = contacts
        dq1, dq2 = reading.dq
        return law.squeeze(
            self._memory,
            self.force.memory,
            self.angle.memory,
            held.told,
            0.5 * (left.force + right.force),
            pose.angle if pose.valid else math.nan,
            dq1,
            dq2,
        )

    def coast(self, reading: Reading, held: GraspState) -> tuple[float, float]:
        """Joint torques [N·m] while frames are late: the push stays, and turning comes to rest.

        Joints are read all the same. Torques that stayed as they are would turn the object on, to
        the end of what damps and steers it.
        """
        if len(self._fingers) == 1:
            finger = self._fingers[0]
            torque = law.coast_alone(self._memory, held.told, finger, reading.dq[finger])
            return (torque, 0.0) if finger == 0 else (0.0, torque)
        return law.coast(self._memory, held.told, *reading.dq)

    def angles(
        self, contacts: list[Contact], pose: ObjectPose, held: GraspState
    ) -> tuple[float, float]:
        """Joint goals [rad] of pure position control.

        What it can't do is why the other laws exist: its finest step is one count of the joints.
        """
        return law.place(
            self._memory,
            self.force.memory,
            self.angle.memory,
            held.told,
            0.5 * (contacts[0].force + contacts[1].force),
            pose.angle if pose.valid else math.nan,
        )

    def _keep_margin(self, contacts: list[Contact], held: GraspState) -> None:
        """Set the force [N] that is gone to, more than asked for where the tips would slip."""
        if not self.slip.due():
            return
        closing = self._memory.item(law.CLOSING_FRICTION)
        self.force.target = self.slip.step(held, contacts, self.force_target, self.holding, closing)
