"""The grip law: forces and the object's angle to joint torques, once both tips touch.

Holds the law and its memory; modes and limits are elsewhere. Two fingers have one motion that
changes the grip (both close) and one that moves the object (q1 + δ, q2 − δ), so the law has two
parts, the 'serial two-phased' one of the soft-fingertip literature:

1. the object's angle error is integrated and fed antisymmetrically to the joints' goal. The object
   turns by dφ/dδ = 2 (a − d + L sin q + e cos q) / W, against the fingers' own sense;
2. joint PD holds that goal on the antisymmetric motion, and the grip is a bias torque: the lever
   arm times the force wanted, plus an integral of the tactile force error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from daemon.records import Contact, ObjectPose
from daemon.settings import Settings

_RAMP = 0.4  # s in which the force goes from what is felt to what is wanted
_TORQUE_SHARE = 0.5  # the integral's bound, as a share of the feed-forward torque


class Joints(NamedTuple):
    """Angles and velocities of the fingers that take part, as plain floats."""

    q: list[float]
    dq: list[float]


class Grip:
    """Force control from the tactile estimate, and steering by the antisymmetric joint motion."""

    def __init__(self, settings: Settings) -> None:
        self._hand = settings.hand
        self._law = settings.control
        self._radius = settings.tip.radius
        self._width = settings.object.width
        self.force_target = 0.0
        self.angle_target = 0.0
        self.steering = False
        self._force = 0.0  # the ramped force
        self._ramp = 0.0  # its rate [N/s]
        self._integral = 0.0  # [N]
        self._angle = 0.0  # the ramped angle
        self._offset = 0.0  # goal of (q1 − q2)/2

    def start(self, joints: Joints, felt: float, force: float) -> None:
        """Take over from the approach with ``felt`` N on the tips."""
        self._force = felt
        self._integral = 0.0
        self._offset = _antisymmetric(joints.q)
        self.steering = False
        self.retarget(force)

    def retarget(self, force: float) -> None:
        """Go to another grip force [N]."""
        self.force_target = force
        self._ramp = max(abs(force - self._force), 0.1 * force) / _RAMP

    def steer(self, present: float, angle: float) -> None:
        """Turn the object from its present angle to ``angle`` [rad]."""
        if not self.steering:
            self._angle = present
        self.angle_target = angle
        self.steering = True

    def torques(
        self, dt: float, joints: Joints, contacts: list[Contact], pose: ObjectPose
    ) -> list[float]:
        """Joint torques [N·m], positive closing, for the fingers that take part."""
        felt = sum(contact.force for contact in contacts) / len(contacts)
        self._force = _toward(self._force, self.force_target, self._ramp * dt)
        self._integral += 2.0 * math.pi * self._law.force_bandwidth * (self._force - felt) * dt
        bound = _TORQUE_SHARE * self.force_target
        self._integral = min(max(self._integral, -bound), bound)
        grip = self._force + self._integral
        arms = [self._lever(q) for q in joints.q]
        if len(arms) == 1:
            return [grip * arms[0] - self._law.joint_damping * joints.dq[0]]
        if self.steering and pose.valid:
            self._steer(dt, joints, contacts, pose)
        error = self._offset - _antisymmetric(joints.q)
        rate = _antisymmetric(joints.dq)
        turn = self._law.joint_stiffness * error - self._law.joint_damping * rate
        close = -self._law.joint_damping * 0.5 * (joints.dq[0] + joints.dq[1])
        return [grip * arms[0] + close + turn, grip * arms[1] + close - turn]

    def _steer(self, dt: float, joints: Joints, contacts: list[Contact], pose: ObjectPose) -> None:
        last = self._angle
        self._angle = _toward(last, self.angle_target, self._law.rotate_speed * dt)
        bandwidth = 2.0 * math.pi * self._law.rotate_bandwidth
        turn = (self._angle - last) + bandwidth * (self._angle - pose.angle) * dt
        self._offset += turn / self._gain(joints, contacts)

    def _gain(self, joints: Joints, contacts: list[Contact]) -> float:
        """dφ/dδ at the present posture."""
        hand = self._hand
        q = 0.5 * (joints.q[0] + joints.q[1])
        d = 0.5 * (contacts[0].d + contacts[1].d)
        reach = hand.finger_length * math.sin(q) + hand.finger_offset * math.cos(q)
        return 2.0 * max(self._radius - d + reach, 0.1 * self._radius) / self._width

    def _lever(self, q: float) -> float:
        """Arm of the normal force about the finger's pivot [m]."""
        return self._hand.finger_length * math.cos(q) - self._hand.finger_offset * math.sin(q)


def _antisymmetric(pair: list[float]) -> float:
    return 0.5 * (pair[0] - pair[1]) if len(pair) == 2 else 0.0


def _toward(value: float, target: float, step: float) -> float:
    return min(value + step, target) if value < target else max(value - step, target)
