"""From tactile frames to contacts and the object's pose: frame → estimate → table.

One `FingerPerception` a sensor; a frame that was seen already costs one comparison. `JointHistory`
tells where the joints were when a frame was sampled, since frames arrive late.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.records import Contact, Frame, ObjectPose
from daemon.settings import Settings
from daemon.tactile.base import TactileSensor
from kinematics.estimator import ContactEstimator
from kinematics.fingers import object_from_contacts
from kinematics.table import ContactTable, lookup

_TARE_FRAMES = 16


class JointHistory:
    """The joints' angles of the last ticks, in a ring."""

    def __init__(self, seconds: float, period: float) -> None:
        self._period = period
        self._size = max(int(seconds / period), 2)
        self._q = [(0.0, 0.0)] * self._size
        self._newest = -1
        self._t = 0.0

    def append(self, t: float, q: list[float]) -> None:
        """Keep the angles read at time ``t``."""
        first = self._newest < 0
        self._newest = (self._newest + 1) % self._size
        self._q[self._newest] = (q[0], q[1])
        self._t = t
        if first:
            self._q = [(q[0], q[1])] * self._size

    def at(self, t: float) -> tuple[float, float]:
        """The angles at time ``t``: the nearest tick's, the oldest kept if that is gone."""
        back = round((self._t - t) / self._period)
        return self._q[self._newest - min(max(back, 0), self._size - 1)]


class FingerPerception:
    """One finger's tactile pipeline: newest frame in, its `Contact` filled in place."""

    def __init__(
        self,
        finger: int,
        sensor: TactileSensor,
        estimator: ContactEstimator,
        table: ContactTable,
        pascal_per_count: float,
    ) -> None:
        self.finger = finger
        self.sensor = sensor
        self.frame: Frame | None = None
        self._estimator = estimator
        self._table = table.data
        self._scale = pascal_per_count
        self._zero: NDArray[np.uint16] | None = None
        self._tare_sum: NDArray[np.uint32] | None = None
        self._tare_left = 0

    def tare(self) -> None:
        """Take the mean of the next frames as zero, cell by cell."""
        self._tare_sum = None
        self._tare_left = _TARE_FRAMES

    def update(self, contact: Contact, history: JointHistory) -> bool:
        """Look for a new frame and fill ``contact`` from it; False when there was none."""
        frame = self.sensor.latest()
        if frame is None or frame is self.frame:
            return False
        self.frame = frame
        contact.seq = frame.seq
        contact.t = frame.t_sample
        contact.t_arrival = frame.t_arrival
        contact.q = history.at(frame.t_sample)[self.finger]
        if not frame.valid:
            contact.valid = False
            return True
        counts = frame.data
        if self._tare_left:
            self._learn_zero(counts)
        if self._zero is not None:
            counts = np.maximum(counts, self._zero) - self._zero
        self.estimate(counts, contact)
        return True

    def estimate(self, counts: NDArray[np.uint16], contact: Contact) -> None:
        """Fill ``contact`` from the counts alone."""
        estimate = self._estimator.update(counts, self._scale)
        contact.valid = estimate.valid
        contact.contact = estimate.contact
        contact.gain = estimate.gain
        if not estimate.contact:
            contact.d = contact.theta = contact.tilt_y = 0.0
            contact.force = contact.energy = 0.0
            contact.d_std = contact.theta_std = 0.0
            contact.inside = True
            return
        contact.d = estimate.d
        contact.theta = estimate.tilt_x
        contact.tilt_y = estimate.tilt_y
        contact.d_std = estimate.d_std
        contact.theta_std = estimate.tilt_x_std
        force, energy, _, _, _, _, inside = lookup(
            self._table, contact.d, _total_tilt(contact.theta, contact.tilt_y)
        )
        contact.force = force
        contact.energy = energy
        contact.inside = inside

    def _learn_zero(self, counts: NDArray[np.uint16]) -> None:
        if self._tare_sum is None:
            self._zero = None
            self._tare_sum = np.zeros(counts.shape, np.uint32)
        self._tare_sum += counts
        self._tare_left -= 1
        if not self._tare_left:
            self._zero = np.round(self._tare_sum / _TARE_FRAMES).astype(np.uint16)


def _total_tilt(tilt_x: float, tilt_y: float) -> float:
    """Angle between the object's normal and the tip's axis: sin² θ = sin² tilt_x + sin² tilt_y."""
    return math.asin(min(math.hypot(math.sin(tilt_x), math.sin(tilt_y)), 1.0))


class ObjectPerception:
    """The object's angle and width from both contacts; costs nothing while a tip is free."""

    def __init__(self, settings: Settings) -> None:
        hand = settings.hand
        self._lengths = (
            0.5 * hand.pivot_separation,
            hand.finger_length,
            hand.finger_offset,
            settings.tip.radius,
        )

    def update(self, contacts: list[Contact], pose: ObjectPose) -> None:
        """Fill ``pose`` in place; without two contacts it is 0 and not valid."""
        left, right = contacts
        pose.valid = left.valid and right.valid and left.contact and right.contact
        if not pose.valid:
            pose.angle = pose.width = 0.0
            return
        pose.angle, pose.width, _ = object_from_contacts(
            left.q, right.q, left.d, right.d, left.theta, right.theta, *self._lengths
        )
