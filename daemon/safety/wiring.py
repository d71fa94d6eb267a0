"""Signs that the servos' IDs are swapped: a joint of one finger moves the other finger's tip.

Joint angles and currents are consistent then, since each servo reports on itself. Only a sensor
shows it: where a joint stands and the other one moves, the wrong tip tilts or is pressed, and a
turn goes the wrong way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.types import FINGERS, State

_STILL = 0.02  # rad by which a joint that waits for the other one may move
_MOVED = 0.05  # rad that the other joint must have closed
# Share of that by which the tip must have tilted: a finger that turns by an angle tilts its tip by
# about as much on an object that slides (0.9 in the simulated hand, 0.25 with the right wiring).
_TILTED = 0.5
_SURE = 2.0  # standard deviations of the tilt besides
_PRESSED = 1.0  # N by which the tip's force must have risen
_SETTLED = 0.07  # s after a touch: the frames' latency, and what the joint needs to stop
_AGAINST = math.radians(4.0)  # that an object has turned against its commanded turn
_SENSES = (1.0, -1.0)  # of a tip's tilt when its finger closes


class WiringWatch:
    """Compares which joint moves with which tip feels it, in an approach and in a turn."""

    def __init__(self, fingers: Sequence[int]) -> None:
        self.swapped = ""  # what was found, empty while all is well
        self._both = len(fingers) == len(FINGERS)
        self._touching = -1  # the one finger that touches, -1: none or both
        self._since = 0.0  # [s]
        self._q = [0.0, 0.0]  # when it had touched [rad]
        self._tilt = math.nan  # likewise [rad]
        self._force = 0.0  # greatest in the first moment [N]
        self._turn = math.nan  # object's angle at the start of a turn [rad]
        self._goal = math.nan  # angle that the object is to be turned to [rad]
        self._sense = 0.0  # of that turn

    def follow(self, state: State) -> None:
        """Take in a tick's state."""
        self.swapped = ""
        if not self._both or not state.reading.valid:
            return
        if state.mode == Mode.GRASPING:
            self._follow_approach(state)
        else:
            self._touching = -1
        if state.mode == Mode.ROTATING:
            self._follow_turn(state)
        else:
            self._turn = math.nan

    def _follow_approach(self, state: State) -> None:
        left, right = (each.valid and each.contact for each in state.contacts)
        finger = -1 if left == right else 0 if left else 1
        if finger != self._touching or finger < 0:
            self._touching, self._since, self._tilt = finger, state.t, math.nan
            return
        contact, q = state.contacts[finger], state.reading.q
        if math.isnan(self._tilt) or state.t - self._since < _SETTLED:
            self._q[:], self._tilt, self._force = q, contact.theta, contact.force
            return
        other = 1 - finger
        closed = q[other] - self._q[other]
        if abs(q[finger] - self._q[finger]) > _STILL:
            return
        tilted = _SENSES[finger] * (contact.theta - self._tilt)
        sure = _SURE * contact.theta_std
        turned = closed > _MOVED and tilted > _TILTED * closed + sure
        pressed = contact.force - self._force > _PRESSED
        if turned or pressed:
            self.swapped = (
                f"the {FINGERS[finger]} tip is moved while the {FINGERS[finger]} joint stands and "
                f"the {FINGERS[other]} one closes: are servos.ids swapped?"
            )

    def _follow_turn(self, state: State) -> None:
        angle, goal = state.object.angle, state.goal.angle
        if goal != self._goal:  # also for NaN; a stream's goal moves on at each tick
            self._goal, self._turn = goal, math.nan
        if math.isnan(self._turn):
            if state.object.valid and abs(goal - angle) > 0.5 * _AGAINST:
                self._turn, self._sense = angle, math.copysign(1.0, goal - angle)
            return
        against = self._sense * (self._turn - angle)
        if state.object.valid and against > _AGAINST:
            self.swapped = (
                f"the object turned by {math.degrees(against):.0f}° against its commanded turn: "
                "are servos.ids swapped?"
            )
