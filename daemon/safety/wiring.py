"""Detect swapped servo IDs, which direct each finger's commands to the other finger.

Joint angles and currents remain consistent, because each servo reports its own values. Only the
tactile sensors show the error. A tip in contact tilts by about the angle through which its finger
rotates. The tilt therefore shows which of the two reported joint angles belongs to the finger. If
the object does not yield, the tip force rises although the servo reports a stationary joint. During
a commanded rotation, the object rotates in the wrong direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.types import FINGERS, State

_STANDING_MAX = 0.02  # maximum motion of the stationary joint [rad]
_CLOSING_MIN = 0.05  # minimum difference between the two joints' closing motions [rad]
_TILT_SIGMA = 2.0  # number of tilt standard deviations added to the tilt threshold
_FORCE_RISE_MIN = 1.0  # minimum tip force increase [N]
# Settling time after a touch [s]. Late frames may still show the closing motion although the joint
# has already stopped. Frames may be 0.1 s old (`safety.frame_age_fault`), and the joint stops
# within 0.05 s.
_SETTLING_TIME = 0.15
_WRONG_ROTATION = math.radians(4.0)  # minimum rotation opposite to the command [rad]
_TILT_SIGNS = (1.0, -1.0)  # sign of the tip tilt while the finger closes


class WiringWatch:
    """Check during approach and rotation that the moving joint drives the responding tip."""

    def __init__(self, fingers: Sequence[int]) -> None:
        self.swapped = ""  # description of a detected swap, or an empty string
        self._has_two_fingers = len(fingers) == len(FINGERS)
        self._touching = -1  # index of the only finger that touches the object, or -1
        self._since = 0.0  # time at which the contact with one finger began [s]
        self._q = [0.0, 0.0]  # joint angles after the touch [rad]
        self._tilt = math.nan  # tip tilt after the touch [rad]
        self._force = 0.0  # tip force after the touch [N]
        self._turn = math.nan  # object angle at the start of a rotation [rad]
        self._goal = math.nan  # commanded object angle [rad]
        self._angle = math.nan  # object angle on the previous tick [rad]
        self._sense = 0.0  # direction of the commanded rotation

    def update(self, state: State) -> None:
        """Check one tick's state."""
        self.swapped = ""
        if not self._has_two_fingers or not state.reading.valid:
            return
        if state.mode == Mode.GRASPING:
            self._check_approach(state)
        else:
            self._touching = -1
        if state.mode == Mode.ROTATING:
            self._check_turn(state)
        else:
            self._turn = math.nan

    def _check_approach(self, state: State) -> None:
        left, right = (each.valid and each.contact for each in state.contacts)
        if not (left or right):
            return  # A light contact may be lost for a few frames, so keep the reference values.
        finger = -1 if left and right else 0 if left else 1
        if finger != self._touching or finger < 0:
            self._touching, self._since, self._tilt = finger, state.t, math.nan
            return
        contact, q = state.contacts[finger], state.reading.q
        if math.isnan(self._tilt) or state.t - self._since < _SETTLING_TIME:
            self._q[:], self._tilt, self._force = q, contact.theta, contact.force
            return
        other = 1 - finger
        closed, other_closed = q[finger] - self._q[finger], q[other] - self._q[other]
        tilted = _TILT_SIGNS[finger] * (contact.theta - self._tilt)
        # A tilt above the threshold matches the motion of the other joint better.
        threshold = 0.5 * (closed + other_closed) + _TILT_SIGMA * contact.theta_std
        follows_other = other_closed - closed > _CLOSING_MIN and tilted > threshold
        pressed = contact.force - self._force > _FORCE_RISE_MIN
        if follows_other or (pressed and abs(closed) < _STANDING_MAX):
            self.swapped = (
                f"the {FINGERS[finger]} tip moves with the {FINGERS[other]} joint instead of the "
                f"{FINGERS[finger]} joint: check whether the servo IDs are swapped (servos.ids)"
            )

    def _check_turn(self, state: State) -> None:
        angle, goal = state.object.angle, state.goal.angle
        # A NaN goal also counts as changed. A streamed goal changes on every tick. If the
        # controller ends a rotation to prevent slip, the new goal is the object's angle. The goal
        # then follows an object that rotates in the wrong direction.
        if goal != self._goal:
            if goal != self._angle:
                self._turn = math.nan
            self._goal = goal
        self._angle = angle
        if math.isnan(self._turn):
            if state.object.valid and abs(goal - angle) > 0.5 * _WRONG_ROTATION:
                self._turn, self._sense = angle, math.copysign(1.0, goal - angle)
            return
        against = self._sense * (self._turn - angle)
        if state.object.valid and against > _WRONG_ROTATION:
            self.swapped = (
                f"the object rotated by {math.degrees(against):.0f}° in the direction opposite to "
                "the command: check whether the servo IDs are swapped (servos.ids)"
            )
