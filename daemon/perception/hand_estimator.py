"""Estimate the contacts and the object pose on each tick.

Frames are precise but late and infrequent; joint readings are frequent but coarse. While an object
is held, the estimator predicts the displacement d and the object angle φ from the joint motion. The
prediction uses the rolling constraints in `hand.grasp_state`. Each frame corrects the predicted
values. `hand_state` defines and predicts the state. `frame_channels` and `grasp_kernels` update the
state with measurements. `docs/estimation.md` explains the model.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softfinger.daemon.perception import frame_channels, grasp_kernels
from softfinger.daemon.perception import hand_state as states
from softfinger.daemon.perception.finger_model import make_prior
from softfinger.daemon.perception.frame_channels import FrameContact
from softfinger.daemon.perception.grasp import (
    AMPLITUDE,
    ANGLE_CHANNEL,
    BALANCE,
    FOOTPRINT,
    TORQUES,
)
from softfinger.daemon.perception.hand_state import HISTORY_TIME, LAW_POINTS, HandFilter, HistoryRow
from softfinger.daemon.perception.prior import RELAXATION_ERROR, Prior
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, VELOCITY_UNIT
from softfinger.daemon.types import Contact, Frame, Goal, ObjectPose, Reading
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.hand.grasp_state import total_tilt

# Standard deviations of two settings
_TAPER_ERROR = 0.1  # `object.taper` [rad]
_LATENCY_ERROR = 0.03  # `tactile.latency` [s]
_GOAL_DISTANCE = 0.25  # position error at which a joint draws the full goal current [rad]
_DEPTHS = np.linspace(0.0, 1.0, LAW_POINTS)  # values of d/radius in `TrackedTip.law_error`


class HandEstimator:
    """Estimator for one hand."""

    def __init__(
        self,
        settings: Settings,
        tables: tuple[ContactTable, ContactTable],
        materials: tuple[Material, Material] | None = None,
        priors: tuple[Prior, Prior] | None = None,
    ) -> None:
        """Create the estimator.

        Each tip has a contact table, priors and a material. The material specifies the error of the
        stress-strain law. By default, the priors come from the settings.
        """
        hand, gear = settings.hand, settings.servos.gear_ratio
        self._fingers = settings.scene.indices
        self._estimates_object = settings.scene.object_model
        self._tables = tables
        self._state = state = HandFilter()
        state.half_separation = 0.5 * hand.pivot_separation
        state.length = hand.finger_length
        state.offset = hand.finger_offset
        state.radius = settings.tip.radius
        state.encoder_resolution = 2.0 * math.pi / (COUNTS_PER_TURN * gear)
        state.velocity_unit = VELOCITY_UNIT / gear
        state.latency = settings.tactile.latency
        state.frame_rate = settings.tactile.rate
        state.frame_age_max = settings.safety.frame_age_fault / settings.tactile.rate
        state.rejected_max = settings.safety.frame_age_hold
        state.contact_force = settings.control.contact_force
        state.response = settings.tactile.response
        state.relaxation[:] = settings.tip.relaxation
        state.relaxation_time[:] = settings.tip.relaxation_times
        control = settings.control
        state.torque_constant = control.torque_constant / control.driving
        state.inertia = control.joint_inertia
        state.load_held = control.load_held
        state.is_single = len(self._fingers) == 1
        state.gain_is_known = settings.estimator.free_gain is False
        state.t = -math.inf
        # Without `tip.relaxation`, the rubber may lose a part of the estimated force in a hold.
        relaxation_error = 0.0 if any(settings.tip.relaxation) else RELAXATION_ERROR
        for finger, table in enumerate(tables):
            law = (
                0.0
                if materials is None
                else materials[finger].force_error(np.maximum(_DEPTHS, 1e-3))
            )
            known = math.hypot(table.max_error, relaxation_error)
            state.tip[finger].law_error[:] = np.hypot(law, known)
            state.tip[finger].relaxation = 1.0 + sum(settings.tip.relaxation)
        if priors is None:
            priors = make_prior(settings, None), make_prior(settings, None)
        self._priors = priors
        self._history: Any = np.zeros(
            round(HISTORY_TIME * settings.loop.rate) + 2, dtype=HistoryRow.dtype
        )
        self._history["t"] = -math.inf
        self._history["relaxation"] = 1.0 + sum(settings.tip.relaxation)
        self.grasp = state.grasp
        self._set_prior(settings, priors)
        self.grasp.tilt_moment_ratio = 0.5 * sum(
            _tilt_moment_ratio(table, state.radius) for table in tables
        )
        self._factors_outdated = True  # True if the factors have changed since they were written
        self._invalid = [Invalid.NO_FRAME] * 2  # reason for rejecting each finger's newest estimate

    def _set_prior(self, settings: Settings, priors: tuple[Prior, Prior]) -> None:
        """Set the priors and reset the state to the priors."""
        state = self._state
        for finger, prior in enumerate(priors):
            for at, (mean, error) in (
                (states.MODULUS, (math.log(prior.modulus[0]), prior.modulus[1])),
                (states.GAIN, (math.log(prior.gain[0]), prior.gain[1])),
                (states.TORQUE, (prior.torque[0] - 1.0, prior.torque[0] * prior.torque[1])),
                (states.ENCODER, (0.0, state.encoder_resolution / math.sqrt(12.0))),
            ):
                state.prior_mean[at + finger], state.prior_variance[at + finger] = mean, error**2
            self.grasp.gain_prior_std[finger] = self.grasp.gain_std[finger] = prior.gain[1]
        for at, mean, error in (
            (states.ANGLE, 0.0, 1.0),
            (states.TAPER, settings.object.taper, _TAPER_ERROR),
            (states.LATENCY, 0.0, _LATENCY_ERROR),
            (states.FRICTION, settings.control.joint_friction, states.TORQUE_NOISE),
        ):
            state.prior_mean[at], state.prior_variance[at] = mean, error**2
        state.mean[:] = state.prior_mean
        state.covariance[:] = np.diag(state.prior_variance)
        self.grasp.nis[:] = 1.0

    def predict(self, reading: Reading, goal: Goal | None = None) -> None:
        """Predict the state at the time of a valid reading.

        From the start of an approach to the end of the grip, ``goal`` is the goal at the time of
        the reading. Otherwise, ``goal`` is None.
        """
        q1, q2 = reading.q
        dq1, dq2 = reading.dq
        current1, current2 = reading.current
        commanded = 0.0, 0.0
        if goal is not None:
            commanded = _commanded_current(goal, 0, q1), _commanded_current(goal, 1, q2)
        states.predict(
            self._state.array,
            self._history,
            reading.t,
            (q1, q2),
            (dq1, dq2),
            (current1, current2),
            commanded,
            goal is not None,
        )

    def update(
        self,
        finger: int,
        frame: Frame,
        estimate: ContactEstimate,
        contact: Contact,
        has_changed: bool = True,
    ) -> None:
        """Update the state with the ``estimate`` from a finger's ``frame``, and fill ``contact``.

        ``has_changed`` is False for a frame that is identical to an earlier frame. During contact,
        an identical frame indicates a frozen board or stale data, so the filter ignores the frame.
        """
        contact.seq, contact.t, contact.t_arrival = frame.seq, frame.t_sample, frame.t_arrival
        self._invalid[finger] = estimate.invalid if frame.valid else Invalid.BAD_FRAME
        if self._invalid[finger]:
            return  # The contact is still predicted from joint motion, but `t_valid` is not set.
        # Before the first joint reading, use the frame alone.
        tip = self._state.tip[finger]
        in_contact = estimate.contact and self._state.t > -math.inf
        if in_contact and tip.in_contact and not has_changed:
            contact.t_valid = frame.t_arrival
            return
        # The limit `tactile.silent` turns torque off after `frame_age_max`. Therefore, report the
        # contact as lost two frames earlier.
        hidden_time = frame.t_arrival - contact.t_valid + 2.0 / self._state.frame_rate
        is_hidden = not in_contact and self._may_hide(finger, estimate.d_std)
        if is_hidden and hidden_time < self._state.frame_age_max:
            return  # The contact is still predicted from joint motion.
        if in_contact and not frame_channels.update(
            self._state.array,
            self._history,
            finger,
            frame.t_sample,
            FrameContact(
                estimate.d, estimate.tilt_x, estimate.tilt_y, estimate.gain, estimate.shear_x
            ),
            estimate.covariance,
            estimate.systematic,
            self._tables[finger].data,
        ):
            self._invalid[finger] = Invalid.CONTRADICTS_JOINTS
            return
        self._factors_outdated = True
        contact.t_valid = frame.t_arrival
        contact.contact, contact.gain = estimate.contact, estimate.gain
        contact.tilt_y, contact.misfit = estimate.tilt_y, estimate.misfit
        contact.shear_x, contact.shear_y = estimate.shear_x, estimate.shear_y
        if not in_contact:
            if tip.in_contact:
                # The friction is measured again during the next approach.
                tip.free_torque = 0.0
                tip.free_torque_max[:] = 0.0
                tip.window_start = self._state.t
            tip.in_contact = False
            self._state.mean[states.D + finger] = 0.0
            self._fill_from_frame(finger, contact, estimate)

    def _may_hide(self, finger: int, d_std: float) -> bool:
        """Return True if a held tip may be in contact although its frame shows no contact.

        The zero offset of the sensor may have fallen, or noise may hide the contact. ``d_std`` is
        the standard deviation of d in the frame [m].
        """
        state, tip = self._state, self._state.tip
        if not (state.is_gripping and tip[0].in_contact and tip[1].in_contact):
            return False
        d, seen = np.zeros(states.STATES), np.zeros(states.STATES)
        d[states.D + finger] = seen[states.D + finger] = seen[states.D_BIAS + finger] = 1.0
        seen_variance = seen @ state.covariance @ seen + d_std**2
        is_certain = d @ state.mean > states.GATE * math.sqrt(d @ state.covariance @ d)
        return bool(is_certain and seen @ state.mean < states.GATE * math.sqrt(seen_variance))

    def write_contacts(self, t: float, contacts: list[Contact], pose: ObjectPose) -> None:
        """Write the estimates at time ``t`` to ``contacts`` and ``pose``."""
        tip = self._state.tip
        in_contact = tip[0].in_contact, tip[1].in_contact
        pose.valid = in_contact[0] and in_contact[1] and self._estimates_object
        pose.angle = pose.width = 0.0
        if in_contact[0] or in_contact[1]:
            result = grasp_kernels.write_grasp(
                self._state.array, self._tables[0].data, self._tables[1].data
            )
            tips = result.left, result.right
            if pose.valid:
                pose.angle, pose.width = result.angle, result.width
        if self._factors_outdated:
            self._factors_outdated = False
            for finger in self._fingers:
                self._write_factors(contacts[finger], finger)
            pose.nis_torque = self.grasp.nis.item(TORQUES)
            pose.nis_balance = self.grasp.nis.item(BALANCE)
        oldest = t - self._state.frame_age_max
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

    def _write_factors(self, contact: Contact, finger: int) -> None:
        """Write a finger's calibration factors and channel consistency to ``contact``."""
        state, grasp = self._state, self.grasp
        at = states.MODULUS + finger
        contact.modulus_scale = modulus = math.exp(state.mean.item(at))
        contact.modulus_scale_std = modulus * math.sqrt(max(state.covariance.item(at, at), 0.0))
        contact.sensor_gain = gain = math.exp(state.mean.item(states.GAIN + finger))
        contact.sensor_gain_std = gain * grasp.gain_std.item(finger)
        at = states.TORQUE + finger
        contact.torque_scale = 1.0 + state.mean.item(at)
        contact.torque_scale_std = math.sqrt(max(state.covariance.item(at, at), 0.0))
        nis = grasp.nis
        contact.nis_angle = nis.item(ANGLE_CHANNEL + finger)
        contact.nis_footprint = nis.item(FOOTPRINT + finger)
        contact.nis_amplitude = nis.item(AMPLITUDE + finger)

    def _fill_from_frame(self, finger: int, contact: Contact, estimate: ContactEstimate) -> None:
        """Fill ``contact`` with the estimate from a single frame.

        The amplitude of a frame depends on both the tip modulus and the sensor gain. If the gain
        was fitted, a deviation in amplitude is attributed to modulus and gain in proportion to
        their prior variances. Otherwise, the frame measures force × gain.
        """
        table, prior = self._tables[finger], self._priors[finger]
        contact.d, contact.theta = estimate.d, estimate.tilt_x
        contact.d_std, contact.theta_std = estimate.d_std, estimate.tilt_x_std
        contact.force = contact.energy = contact.force_std = 0.0
        contact.inside = True
        if not estimate.contact:
            # Noise may hide a light contact.
            contact.force_std = float(table(contact.d_std, 0.0, edge=True).force)
            return
        tilt = total_tilt(contact.theta, contact.tilt_y)
        found = table(contact.d, tilt, edge=True)
        contact.inside = bool(found.inside)
        stiff, gain = prior.modulus[1] ** 2, prior.gain[1] ** 2
        if estimate.covariance[3, 3] > 0.0:
            expected = prior.modulus[0] * prior.gain[0]
            modulus = prior.modulus[0] * (contact.gain / expected) ** (stiff / (stiff + gain))
            factor_variance = stiff * gain / (stiff + gain)
        else:
            modulus, factor_variance = contact.gain / prior.gain[0], gain
        contact.force, contact.energy = modulus * float(found.force), modulus * float(found.energy)
        along = contact.theta / tilt if tilt > 0.0 else 0.0
        across = contact.tilt_y / tilt if tilt > 0.0 else 0.0
        by_tilt = found.force_theta
        slopes = modulus * np.array([found.force_d, by_tilt * along, by_tilt * across])
        fraction = contact.d / self._state.radius
        law_error = np.interp(fraction, _DEPTHS, self._state.tip[finger].law_error)
        relative = law_error**2 + factor_variance
        variance = slopes @ estimate.covariance[:3, :3] @ slopes + relative * contact.force**2
        contact.force_std = math.sqrt(variance)


def _tilt_moment_ratio(table: ContactTable, radius: float) -> float:
    """Return (∂U/∂θ)/(F θ d) for a nearly upright tip (springs: 2/3, solid rubber: about 0)."""
    d, theta = 0.15 * radius, 0.05
    contact = table(d, theta)
    return float(contact.energy_theta / (contact.force * d)) / theta


def _commanded_current(goal: Goal, finger: int, q: float) -> float:
    """Return the goal current [A] if the joint is far from its goal, otherwise 0."""
    return goal.current[finger] if goal.q[finger] - q > _GOAL_DISTANCE else 0.0
