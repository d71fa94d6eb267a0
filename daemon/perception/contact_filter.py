"""Contacts between the tactile frames: a Kalman filter, predicted by joints, updated by frames.

A frame is exact but late and rare; joints are fresh but coarse. While an object is held, joint
motion carries d and the object's angle φ on by the rolling constraints (`hand.grasp_state`). A
frame is compared with the prediction for the instant at which it was sampled, and this innovation,
weighed by both variances, updates the present.

An encoder reads whole counts: the tracked angle runs on with the measured velocity and is held
inside the count that was read, so that it is exact at each count's edge.

φ is the angle of the bisector of the object's faces; how much these lean towards each other, the
taper α, is found from the frames of both tips, beginning with ``object.taper``. So each tip's θ is
what its own sensor measures, whatever is held. A shifted sensor looks the same; that is not judged
here: the safety limit ``hand.angle`` compares the frames with ``object.taper`` alone. A disc has no
faces and no angle: φ is the direction of the line from contact to contact, not how the disc is
turned, and ``rotate`` goes by it. That line goes with the tips: it turns by 2 L sin q/(2R + 2a − d1
− d2) of what the joints lean, 0.4 instead of the predicted 1.5 for R = 20 mm and the default hand.
So the frames have more to correct, turning takes longer, and the disc rolls further than is asked;
since its curved contact looks less tilted than it is, φ comes out a fifth too small. Where the
fingers stand straight or lean outwards the line does not follow the joints: a disc of R ≥ 30 mm is
held, but turning it ends at the tips' limits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception import contact_filter_kernels as kernels
from softfinger.daemon.perception.contact_filter_kernels import FilterState, Past
from softfinger.daemon.perception.scales import (
    GAIN,
    MODULUS,
    TORQUE,
    UNKNOWN,
    Prior,
    Scales,
    end_touch,
    set_prior,
)
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, VELOCITY_UNIT
from softfinger.daemon.types import FINGERS, Contact, Frame, Goal, ObjectPose, Reading
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.hand.grasp_state import total_tilt

FloatArray = NDArray[np.float64]

_FAR = 0.25  # rad off its goal, a grip's joint takes all the current that it may


class ContactFilter:
    """The filter of one hand. Costs nothing but a comparison while no tip is touched."""

    def __init__(
        self,
        settings: Settings,
        tables: tuple[ContactTable, ContactTable],
        materials: tuple[Material, Material] | None = None,
        priors: tuple[Prior, Prior] = (UNKNOWN, UNKNOWN),
    ) -> None:
        """Take each tip's table, its material, whose law may be off its points, and its scales."""
        hand, gear = settings.hand, settings.servos.gear_ratio
        self._fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self._with_object = settings.scene.object_model
        self._age_max = settings.safety.frame_age_fault * (1.0 / settings.tactile.rate)
        self._tables = tables[0].data, tables[1].data
        self._state = state = FilterState()
        state.half_separation = 0.5 * hand.pivot_separation
        state.length = hand.finger_length
        state.offset = hand.finger_offset
        state.radius = settings.tip.radius
        state.count = 2.0 * math.pi / (COUNTS_PER_TURN * gear)
        state.slow = 0.5 * VELOCITY_UNIT / gear
        state.response = settings.tactile.response
        state.relaxation[:] = settings.tip.relaxation
        state.relaxation_time[:] = settings.tip.relaxation_times
        state.torque_constant = settings.control.torque_constant / settings.control.driving
        state.taper = state.assumed_taper = settings.object.taper
        state.alone = len(self._fingers) == 1
        state.gain_known = settings.estimator.free_gain is False
        state.t = -math.inf
        ratios = np.linspace(1e-3, 1.0, kernels.LAW_POINTS)
        for finger, table in enumerate(tables):
            law = 0.0 if materials is None else materials[finger].force_error(ratios)
            state.tip[finger].law[:] = np.hypot(law, table.max_error)
            state.tip[finger].firmness = 1.0 + sum(settings.tip.relaxation)
        control = settings.control
        set_prior(
            state.grasp.scales,
            priors,
            control.joint_friction,
            control.joint_inertia,
            control.load_held,
        )
        self._priors = priors
        self._history: Any = np.zeros(
            round(kernels.HISTORY * settings.loop.rate) + 2, dtype=Past.dtype
        )
        self._history["t"] = -math.inf
        self._history["firmness"] = 1.0 + sum(settings.tip.relaxation)
        self.grasp = state.grasp
        self.grasp.turning = 0.5 * sum(_turning(table, state.radius) for table in tables)
        self._read = False  # the joints are known
        self._in_contact = [False, False]  # tips that touch and are carried on by the joints
        self._news = True  # the scales may have changed
        self._invalid = [Invalid.NO_FRAME] * 2  # why the newest frame's estimate can't be used

    def predict(self, reading: Reading, goal: Goal | None = None) -> None:
        """Predict the estimates at the instant of a good reading.

        ``goal``: what it was to be, where a grip set its currents.
        """
        self._read = True
        q1, q2 = reading.q
        dq1, dq2 = reading.dq
        current1, current2 = reading.current
        kernels.predict(
            self._state.array,
            self._history,
            reading.t,
            (q1, q2),
            (dq1, dq2),
            (current1, current2),
            (0.0, 0.0)
            if goal is None
            else (_commanded_current(goal, 0, q1), _commanded_current(goal, 1, q2)),
        )

    def update(
        self,
        finger: int,
        frame: Frame,
        estimate: ContactEstimate,
        contact: Contact,
        changes: bool = True,
    ) -> None:
        """Update by a finger's new ``frame`` and its ``estimate``; write both into ``contact``.

        In a contact a frame that ``changes`` nothing, bit by bit, tells nothing new: a board that
        has frozen, or repeats its last second, sends it while the joints close.
        """
        contact.seq, contact.t, contact.t_arrival = frame.seq, frame.t_sample, frame.t_arrival
        self._invalid[finger] = estimate.invalid if frame.valid else Invalid.FRAME
        if self._invalid[finger]:
            return  # nothing is learnt: the contact is carried on, and grows older
        # Before a first reading nothing is known of the joints: the frame stands for itself.
        in_contact = estimate.contact and self._read
        if in_contact and self._in_contact[finger] and not changes:
            contact.t_valid = frame.t_arrival
            return
        if in_contact and not kernels.update(
            self._state.array,
            self._history,
            finger,
            frame.t_sample,
            (
                estimate.d,
                estimate.tilt_x,
                estimate.tilt_y,
                estimate.gain,
                estimate.shear_x,
            ),
            estimate.covariance,
            estimate.systematic,
            self._tables[finger],
        ):
            self._invalid[finger] = Invalid.JOINTS
            return
        self._touch(finger, in_contact)
        self._news = True
        contact.t_valid = frame.t_arrival
        contact.contact, contact.gain = estimate.contact, estimate.gain
        contact.tilt_y, contact.misfit = estimate.tilt_y, estimate.misfit
        contact.shear_x, contact.shear_y = estimate.shear_x, estimate.shear_y
        if not in_contact:
            tip = self._state.tip[finger]
            if tip.in_contact:
                self.grasp.free_torque[finger] = 0.0  # the next approach shows it anew
                tip.efforts[:] = 0.0
            tip.in_contact, tip.d.mean = False, 0.0
            _fill_from_frame(
                contact,
                estimate,
                self._tables[finger],
                tip.law,
                self._priors[finger],
                self._state.radius,
            )

    def _touch(self, finger: int, in_contact: bool) -> None:
        """Note whether a finger's tip touches; what scales learn of a touch may end with it."""
        touching = any(self._in_contact)
        self._in_contact[finger] = in_contact
        if touching and not any(self._in_contact):
            end_touch(self.grasp.scales)

    def write_contacts(
        self, t: float, contacts: list[Contact], pose: ObjectPose, phase: int = kernels.OTHER
    ) -> None:
        """Write the estimates of time ``t`` into contacts and pose.

        By the ``phase`` of a grip torques are taken for what they tell.
        """
        in_contact = self._in_contact
        pose.valid = in_contact[0] and in_contact[1] and self._with_object
        pose.angle = pose.width = 0.0
        if in_contact[0] or in_contact[1]:
            left, right, angle, width = kernels.write_grasp(self._state.array, *self._tables, phase)
            tips = left, right
            if pose.valid:
                pose.angle, pose.width = angle, width
        if self._news:
            self._news = False
            for finger in self._fingers:
                _write_scales(contacts[finger], self.grasp.scales, finger)
        oldest = t - self._age_max
        for finger in self._fingers:
            contact = contacts[finger]
            if in_contact[finger]:
                (
                    contact.d,
                    contact.theta,
                    contact.force,
                    contact.energy,
                    contact.d_std,
                    contact.theta_std,
                    contact.force_std,
                    contact.inside,
                ) = tips[finger]
            contact.invalid = self._invalid[finger]
            if not contact.t_valid >= oldest:
                contact.invalid, pose.valid = contact.invalid or Invalid.STALE, False


def _commanded_current(goal: Goal, finger: int, q: float) -> float:
    """The current [A] of a goal that is so far from ``q`` that nothing but its bound counts."""
    return goal.current[finger] if goal.q[finger] - q > _FAR else 0.0


def _write_scales(contact: Contact, scales: Scales, finger: int) -> None:
    mean, covariance = scales.mean, scales.covariance
    at = MODULUS + finger
    contact.modulus_scale = modulus = math.exp(mean.item(at))
    contact.modulus_scale_std = modulus * math.sqrt(covariance.item(at, at))
    at = GAIN + finger
    contact.sensor_gain = gain = math.exp(mean.item(at))
    contact.sensor_gain_std = gain * math.sqrt(covariance.item(at, at))
    at = TORQUE + finger
    contact.torque_scale = 1.0 + mean.item(at)
    contact.torque_scale_std = math.sqrt(covariance.item(at, at))


def _turning(table: ContactTable, radius: float) -> float:
    """∂U/∂θ over F θ d of a tip that is about upright: 2/3 of springs, about 0 of solid rubber."""
    d, theta = 0.15 * radius, 0.05
    contact = table(d, theta)
    return float(contact.energy_theta / (contact.force * d)) / theta


def _fill_from_frame(
    contact: Contact,
    estimate: ContactEstimate,
    table: FloatArray,
    law: FloatArray,
    prior: Prior,
    radius: float,
) -> None:
    """Fill ``contact`` from one frame's estimate alone; ``table`` and ``law``: its tip's.

    By the ``prior``, modulus and gain share out what the frame is higher than the model.
    """
    contact.d, contact.theta = estimate.d, estimate.tilt_x  # and without a contact 0, as all else
    contact.d_std, contact.theta_std = estimate.d_std, estimate.tilt_x_std
    contact.force = contact.energy = contact.force_std = 0.0
    contact.inside = True
    if not estimate.contact:
        contact.force_std = lookup(table, contact.d_std, 0.0)[0]  # of what could hide
    else:
        tilt = total_tilt(contact.theta, contact.tilt_y)
        force, energy, by_d, by_tilt, _, _, contact.inside = lookup(table, contact.d, tilt)
        stiff, gain = prior.modulus[1] ** 2, prior.gain[1] ** 2
        expected = prior.modulus[0] * prior.gain[0]
        modulus = prior.modulus[0] * (contact.gain / expected) ** (stiff / (stiff + gain))
        contact.force, contact.energy = modulus * force, modulus * energy
        along = contact.theta / tilt if tilt > 0.0 else 0.0
        across = contact.tilt_y / tilt if tilt > 0.0 else 0.0
        slopes = modulus * np.array([by_d, by_tilt * along, by_tilt * across])
        law_error = np.interp(contact.d / radius, np.linspace(0.0, 1.0, kernels.LAW_POINTS), law)
        relative = law_error**2 + stiff * gain / (stiff + gain)
        variance = slopes @ estimate.covariance[:3, :3] @ slopes + relative * contact.force**2
        contact.force_std = math.sqrt(variance)
