"""The hand's state between the tactile frames: predicted by joints, corrected by channels.

A frame is exact but late and rare; joints are fresh but coarse. While an object is held, joint
motion carries d and the object's angle φ on by the rolling constraints (`hand.grasp_state`). A
frame is compared with the prediction for the instant at which it was sampled. `hand_state` has the
state and its prediction, `hand_channels` what corrects it.

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

from softfinger.daemon.perception import hand_channels as channels
from softfinger.daemon.perception import hand_state as states
from softfinger.daemon.perception.hand_state import HISTORY, LAW_POINTS, HandFilter, Past
from softfinger.daemon.perception.known import UNKNOWN, Prior
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

_TAPER_ERROR = 0.1  # rad that `object.taper` may be off
_LATENCY_ERROR = 0.03  # s that `tactile.latency` may
_FRICTION_ERROR = 0.05  # N·m that `control.joint_friction` may
_FAR = 0.25  # rad off its goal, a grip's joint takes all the current that it may


class HandEstimator:
    """The estimator of one hand. Costs nothing but a comparison while no tip is touched."""

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
        self._state = state = HandFilter()
        state.half_separation = 0.5 * hand.pivot_separation
        state.length = hand.finger_length
        state.offset = hand.finger_offset
        state.radius = settings.tip.radius
        state.count = 2.0 * math.pi / (COUNTS_PER_TURN * gear)
        state.velocity_unit = VELOCITY_UNIT / gear
        state.latency = settings.tactile.latency
        state.response = settings.tactile.response
        state.relaxation[:] = settings.tip.relaxation
        state.relaxation_time[:] = settings.tip.relaxation_times
        control = settings.control
        state.torque_constant = control.torque_constant / control.driving
        state.inertia = control.joint_inertia
        state.held = control.load_held
        state.alone = len(self._fingers) == 1
        state.gain_known = settings.estimator.free_gain is False
        state.t = -math.inf
        ratios = np.linspace(1e-3, 1.0, LAW_POINTS)
        for finger, table in enumerate(tables):
            law = 0.0 if materials is None else materials[finger].force_error(ratios)
            state.tip[finger].law[:] = np.hypot(law, table.max_error)
            state.tip[finger].firmness = 1.0 + sum(settings.tip.relaxation)
        self._priors = priors
        self._history: Any = np.zeros(round(HISTORY * settings.loop.rate) + 2, dtype=Past.dtype)
        self._history["t"] = -math.inf
        self._history["firmness"] = 1.0 + sum(settings.tip.relaxation)
        self.grasp = state.grasp
        self._set_prior(settings, priors)
        self.grasp.turning = 0.5 * sum(_turning(table, state.radius) for table in tables)
        self._read = False  # the joints are known
        self._has_news = True  # a frame has come since the calibration factors were written
        self._in_contact = [False, False]  # tips that touch and are carried on by the joints
        self._invalid = [Invalid.NO_FRAME] * 2  # why the newest frame's estimate can't be used

    def _set_prior(self, settings: Settings, priors: tuple[Prior, Prior]) -> None:
        """Write what is known before anything touches, and begin with it."""
        state = self._state
        for finger, prior in enumerate(priors):
            for at, (mean, error) in (
                (states.MODULUS, (math.log(prior.modulus[0]), prior.modulus[1])),
                (states.GAIN, (math.log(prior.gain[0]), prior.gain[1])),
                (states.TORQUE, (prior.torque[0] - 1.0, prior.torque[1])),
                (states.ENCODER, (0.0, state.count / math.sqrt(12.0))),
            ):
                state.expected[at + finger], state.prior[at + finger] = mean, error**2
            self.grasp.gain_prior[finger] = self.grasp.gain_std[finger] = prior.gain[1]
        for at, mean, error in (
            (states.ANGLE, 0.0, 1.0),
            (states.TAPER, settings.object.taper, _TAPER_ERROR),
            (states.LATENCY, 0.0, _LATENCY_ERROR),
            (states.FRICTION, settings.control.joint_friction, _FRICTION_ERROR),
        ):
            state.expected[at], state.prior[at] = mean, error**2
        state.mean[:] = state.expected
        state.covariance[:] = np.diag(state.prior)

    def predict(self, reading: Reading, goal: Goal | None = None) -> None:
        """Predict the estimates at the instant of a good reading.

        ``goal``: what it was to be, where a grip set its currents.
        """
        self._read = True
        q1, q2 = reading.q
        dq1, dq2 = reading.dq
        current1, current2 = reading.current
        states.predict(
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
        if in_contact and not channels.update(
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
        self._in_contact[finger] = in_contact
        self._has_news = True
        contact.t_valid = frame.t_arrival
        contact.contact, contact.gain = estimate.contact, estimate.gain
        contact.tilt_y, contact.misfit = estimate.tilt_y, estimate.misfit
        contact.shear_x, contact.shear_y = estimate.shear_x, estimate.shear_y
        if not in_contact:
            tip = self._state.tip[finger]
            if tip.in_contact:
                self.grasp.free_torque[finger] = 0.0  # the next approach shows it anew
                tip.efforts[:] = 0.0
            tip.in_contact = False
            self._state.mean[states.D + finger] = 0.0
            _fill_from_frame(
                contact,
                estimate,
                self._tables[finger],
                tip.law,
                self._priors[finger],
                self._state.radius,
            )

    def write_contacts(self, t: float, contacts: list[Contact], pose: ObjectPose) -> None:
        """Write the estimates of time ``t`` into contacts and pose."""
        in_contact = self._in_contact
        pose.valid = in_contact[0] and in_contact[1] and self._with_object
        pose.angle = pose.width = 0.0
        if in_contact[0] or in_contact[1]:
            left, right, angle, width = channels.write_grasp(self._state.array, *self._tables)
            tips = left, right
            if pose.valid:
                pose.angle, pose.width = angle, width
        if self._has_news:
            self._has_news = False
            for finger in self._fingers:
                self._write_scales(contacts[finger], finger)
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

    def _write_scales(self, contact: Contact, finger: int) -> None:
        state, grasp = self._state, self.grasp
        at = states.MODULUS + finger
        contact.modulus_scale = modulus = math.exp(state.mean.item(at))
        contact.modulus_scale_std = modulus * math.sqrt(max(state.covariance.item(at, at), 0.0))
        contact.sensor_gain = gain = math.exp(state.mean.item(states.GAIN + finger))
        contact.sensor_gain_std = gain * grasp.gain_std.item(finger)
        at = states.TORQUE + finger
        contact.torque_scale = 1.0 + state.mean.item(at)
        contact.torque_scale_std = math.sqrt(max(state.covariance.item(at, at), 0.0))


def _commanded_current(goal: Goal, finger: int, q: float) -> float:
    """The current [A] of a goal that is so far from ``q`` that nothing but its bound counts."""
    return goal.current[finger] if goal.q[finger] - q > _FAR else 0.0


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
        law_error = np.interp(contact.d / radius, np.linspace(0.0, 1.0, LAW_POINTS), law)
        relative = law_error**2 + stiff * gain / (stiff + gain)
        variance = slopes @ estimate.covariance[:3, :3] @ slopes + relative * contact.force**2
        contact.force_std = math.sqrt(variance)
