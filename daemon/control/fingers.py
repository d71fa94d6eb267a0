"""Read the fingers' contacts and set the joint goals for the control state machine."""

from __future__ import annotations

import math

from softfinger.daemon.control.grip_kernels import ROTATION_MIN
from softfinger.daemon.control.setpoint import Setpoint, SetpointState
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Goal, State

# Distance from the joint angle to the goal angle under torque control [rad]. If the distance is at
# least 0.25 rad, the motor current limit determines the torque (see `hand_estimator`). The distance
# is smaller than `safety.goal_reach`, so the goal may jump from one side of the joint angle to the
# other.
_GOAL_OFFSET = 0.35
# Margin between the maximum tilt during a rotation and the tilt that triggers a fault [rad].
_TILT_RESERVE = 0.1


def range_text(angle: float, low: float, high: float) -> str:
    """Return the "found …, expected …" part of a message about an out-of-range angle [rad]."""
    found, lower, upper = (f"{math.degrees(each):.1f}°" for each in (angle, low, high))
    expected = f"{lower} to {upper} ({low:.2f} to {high:.2f} rad)"
    return f"found {found} ({angle:.4g} rad), expected {expected}"


class Fingers:
    """Fingers in the scene, with their contacts and joint setpoints."""

    def __init__(self, settings: Settings, state: State, grasp: GraspState) -> None:
        """Create the fingers; ``state`` and ``grasp`` are read on each tick but never written."""
        self.indices = settings.scene.indices
        self.reading, self.pose, self.grasp = state.reading, state.object, grasp
        self._settings, self._contacts = settings, state.contacts
        dt, smooth = 1.0 / settings.loop.rate, settings.control.smooth_time
        self._setpoints = [Setpoint(dt, smooth, SetpointState()) for _ in FINGERS]

    # Contacts

    @property
    def in_contact(self) -> bool:
        """True if all fingers are in contact."""
        return all(self._contacts[index].contact for index in self.indices)

    @property
    def force(self) -> float:
        """Mean tip force [N]."""
        return sum(self._contacts[index].force for index in self.indices) / len(self.indices)

    def turning_range(self) -> tuple[float, float]:
        """Return the minimum and maximum angle [rad] to which this grip can rotate the object.

        When the object rotates by φ, each joint rotates by ψ = φ/(r1 + r2). The factors r1 and r2
        are in `GraspState.rolling_ratio`. The tilt of each tip then changes by φ + ψ. The joint
        and tilt limits determine the range.
        """
        settings, present_angle = self._settings, self.pose.angle
        rotation = self.grasp.rolling_ratio[0] + self.grasp.rolling_ratio[1]
        joint_ratio = 1.0 / max(rotation, ROTATION_MIN)
        low, high = -math.inf, math.inf
        for index, sense in ((0, 1.0), (1, -1.0)):
            contact, q = self._contacts[index], self.reading.q[index]
            depth = 1.0 - contact.d / settings.tip.radius
            reach = math.asin(max(depth, 0.0)) - settings.safety.theta_margin - _TILT_RESERVE
            low = max(low, (-reach - contact.theta) / (1.0 + joint_ratio))
            high = min(high, (reach - contact.theta) / (1.0 + joint_ratio))
            down, up = settings.hand.q_min[index] - q, settings.hand.q_max[index] - q
            ends = sorted((sense * down / joint_ratio, sense * up / joint_ratio))
            low, high = max(low, ends[0]), min(high, ends[1])
        return present_angle + min(low, 0.0), present_angle + max(high, 0.0)

    def limited_angle(self, angle: float) -> float:
        """Limit an object ``angle`` [rad] to `turning_range`."""
        low, high = self.turning_range()
        return min(max(angle, low), high)

    def turn_refusal(self, angle: float) -> str:
        """Return the reason why the object can't rotate to ``angle`` [rad], or "" if it can."""
        if not self.pose.valid:
            return "the object's angle is unknown"
        low, high = self.turning_range()
        return "" if low <= angle <= high else f"angle: {range_text(angle, low, high)} in this grip"

    # Setpoints

    def hold_here(self) -> None:
        """Set all setpoints to the present joint angles, and set the setpoint speeds to zero."""
        for index, q in enumerate(self.reading.q):
            self._setpoints[index].reset(q)

    def set_target(self, index: int, q: float) -> None:
        """Set the setpoint target of one joint to ``q`` [rad]."""
        self._setpoints[index].target = q

    def close_fingers(self, touching: set[int]) -> set[int]:
        """Close the fingers that are not in contact; return the indices of the fingers in contact.

        ``touching`` is the set that this function returned on the previous tick. A finger that has
        just come into contact stops at its present angle.
        """
        law, now_touching = self._settings.control, set[int]()
        for index in self.indices:
            contact = self._contacts[index]
            if not (contact.valid and contact.contact and contact.force > law.contact_force):
                self.set_target(index, self._settings.hand.q_max[index])
                continue
            now_touching.add(index)
            if index not in touching:
                self._setpoints[index].reset(self.reading.q[index])
        return now_touching

    def advance_setpoints(self, rate: float) -> bool:
        """Advance the setpoints at up to ``rate`` [rad/s]; return True if all have arrived."""
        arrived = [joint.step(rate) for joint in self._setpoints]
        return all(arrived)

    @property
    def distance_max(self) -> float:
        """Largest difference between a joint angle and the target of its setpoint [rad]."""
        return max(abs(self.reading.q[i] - self._setpoints[i].target) for i in self.indices)

    # Goals

    def follow_setpoints(self, goal: Goal, current: float) -> None:
        """Set goals so that the joints follow their setpoints with at most ``current`` [A]."""
        for index in self.indices:
            goal.q[index] = self._setpoints[index].value
            goal.current[index] = current

    def apply_torques(self, goal: Goal, torques: tuple[float, float]) -> None:
        """Set goals that produce joint ``torques`` [N·m]; positive torques close the fingers."""
        for index in self.indices:
            current = torques[index] / self._settings.control.torque_constant
            goal.q[index] = self.reading.q[index] + math.copysign(_GOAL_OFFSET, current)
            goal.current[index] = abs(current)
