"""Contacts between the tactile frames: predicted from the joints each tick, corrected by frames.

A frame is exact but late and rare; joints are fresh but coarse. While an object is held, joint
motion carries d and the object's angle φ on by the rolling constraints (`hand.grasp_state`). A
frame is compared with what was predicted for the instant at which it was sampled, and the
difference, weighed by both variances, corrects the present. Holds this filter and nothing that acts
on it.

A reading says only within which count a joint is: the tracked angle runs on with the measured
velocity and is held inside that count, so that it is exact at each count's edge.

φ is the angle of the bisector of the object's faces; how much these lean towards each other, the
taper α, is found from the frames of both tips, beginning with ``object.taper``. So each tip's θ is
what its own sensor says, whatever is held. A shifted sensor looks the same, and is not judged here:
the safety limit ``hand.angle`` compares the frames with ``object.taper`` alone. A disc has no faces
and no angle: φ is the direction of the line from contact to contact, not how the disc is turned,
and ``rotate`` goes by it. That line goes with the tips: it turns by 2 L sin q/(2R + 2a − d1 − d2)
of what the joints lean, 0.4 instead of the predicted 1.5 for R = 20 mm and the default hand. So the
frames have more to correct, turning takes longer, and the disc rolls further than is asked; since
its curved contact looks less tilted than it is, φ comes out a fifth too small. Where the fingers
stand straight or lean outwards the line does not follow the joints: a disc of R ≥ 30 mm is held,
but turning it ends at the tips' limits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception import contact_filter_kernels
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, VELOCITY_UNIT
from softfinger.daemon.types import FINGERS, Contact, Frame, ObjectPose, Reading
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.hand.grasp_state import total_tilt

FloatArray = NDArray[np.float64]


class _Number:
    """One number that a `GraspState` was told."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, grasp: GraspState, owner: type[GraspState]) -> float:
        return grasp.told.item(self._place)

    def __set__(self, grasp: GraspState, value: float) -> None:
        grasp.told[self._place] = value


class _Pair:
    """Two of them, (left, right), ``step`` places apart."""

    def __init__(self, place: int, step: int = 1) -> None:
        self._places = slice(place, place + step + 1, step)

    def __get__(self, grasp: GraspState, owner: type[GraspState]) -> list[float]:
        pair: list[float] = grasp.told[self._places].tolist()
        return pair

    def __set__(self, grasp: GraspState, value: list[float]) -> None:
        grasp.told[self._places] = value


class GraspState:
    """How the held object answers the joints: what a grip law needs. Pairs are (left, right).

    It is one array that a kernel writes and others read; the names are for people and slow work.
    """

    __slots__ = ("told",)

    q = _Pair(contact_filter_kernels.JOINT)  # tracked joints [rad]
    arm = _Pair(contact_filter_kernels.ARM)  # ∂(d1 + d2)/∂q, the force's lever [m]
    turn = _Pair(contact_filter_kernels.TURN)  # φ̇ = turn1 q̇1 − turn2 q̇2
    slide = _Number(contact_filter_kernels.SLIDE)  # ∂(d1 + d2)/∂φ [m/rad]
    taper = _Number(
        contact_filter_kernels.OBJECT_TAPER
    )  # rad between the object's faces, as both tips feel them
    lever = _Pair(contact_filter_kernels.LEVER)  # torque over force by the energy [m]
    stiffness = _Pair(
        contact_filter_kernels.TIP_STIFFNESS, contact_filter_kernels.TIP_SIZE
    )  # ∂F/∂d [N/m]
    shear = _Number(
        contact_filter_kernels.SHEAR
    )  # shear over normal force, by the object's balance, unloaded
    normal = _Pair(contact_filter_kernels.NORMAL)  # normal forces [N]
    load = _Number(
        contact_filter_kernels.LOAD
    )  # what each tip bears along its face, by the joints' torques [N]
    load_lever = _Number(
        contact_filter_kernels.LOAD_LEVER
    )  # and the lever of that load about the pivots [m]
    stray = _Number(
        contact_filter_kernels.STRAYED
    )  # turning of the object that no joint explains, summed [rad]
    angle_std = _Number(contact_filter_kernels.ANGLE_STD)  # of the object's angle [rad]

    def __init__(self) -> None:
        self.told = np.zeros(contact_filter_kernels.TOLD_SIZE)


class ContactFilter:
    """The filter of one hand. Costs nothing but a comparison while no tip is touched."""

    def __init__(self, settings: Settings, tables: tuple[ContactTable, ContactTable]) -> None:
        """``tables``: what each tip feels, which may be of different materials."""
        hand = settings.hand
        self._with_object = settings.scene.object_model
        self._tables = tables[0].data, tables[1].data
        self._m = np.zeros(contact_filter_kernels.MEMORY)
        self._m[: contact_filter_kernels.COUNT + 2] = (
            0.5 * hand.pivot_separation,
            hand.finger_length,
            hand.finger_offset,
            settings.tip.radius,
            2.0 * math.pi / (COUNTS_PER_TURN * settings.servos.gear_ratio),
            float(len(settings.scene.fingers) == 1),
        )
        self._torque_constant = settings.control.torque_constant
        self._m[contact_filter_kernels.SLOW] = 0.5 * VELOCITY_UNIT / settings.servos.gear_ratio
        self._m[contact_filter_kernels.TOLD] = self._m[contact_filter_kernels.TAPER] = (
            settings.object.taper
        )
        self._m[contact_filter_kernels.T] = -math.inf
        self._history = np.full(
            (
                round(contact_filter_kernels.HISTORY * settings.loop.rate) + 2,
                contact_filter_kernels.H_SIZE,
            ),
            -math.inf,
        )
        self._live = [False, False]  # tips that touch and are carried on by the joints
        self._sound = [False, False]  # the newest frame's estimate can be used
        self._fingers = [FINGERS.index(finger) for finger in sorted(settings.scene.fingers)]
        self._age_max = settings.safety.frame_age_fault * (1.0 / settings.tactile.rate)
        self.grasp = GraspState()

    def switch_off(self) -> None:
        """Pass frames on as they are, late and rare: to show what prediction is worth."""
        self._m[contact_filter_kernels.RAW] = 1.0

    def advance(self, reading: Reading) -> None:
        """Carry the estimates on to the instant of a good reading."""
        q, dq, current = reading.q, reading.dq, reading.current
        self._m[contact_filter_kernels.TORQUE] = self._torque_constant * current[0]
        self._m[contact_filter_kernels.TORQUE + 1] = self._torque_constant * current[1]
        contact_filter_kernels.advance(self._m, self._history, reading.t, q[0], q[1], dq[0], dq[1])

    def correct(
        self, finger: int, frame: Frame, estimate: ContactEstimate, contact: Contact
    ) -> None:
        """Take in one finger's new ``frame`` and its ``estimate``; they show in ``contact``."""
        contact.seq, contact.t, contact.t_arrival = frame.seq, frame.t_sample, frame.t_arrival
        sound = self._sound[finger] = frame.valid and estimate.valid
        if not sound:
            return  # no news: the contact is carried on, and its age tells safety
        contact.t_sound = frame.t_arrival
        # Before a first reading nothing is known of the joints: the frame stands for itself.
        live = self._live[finger] = (
            estimate.contact and self._m[contact_filter_kernels.T] > -math.inf
        )
        if not live:
            self._m[contact_filter_kernels.LIVE + finger] = self._m[
                contact_filter_kernels.D + finger
            ] = 0.0
            _fill_from_frame(contact, estimate, self._tables[finger])
            return
        contact.contact = True
        contact.tilt_y, contact.gain, contact.misfit = (
            estimate.tilt_y,
            estimate.gain,
            estimate.misfit,
        )
        d_std, theta_std = estimate.d_std, estimate.tilt_x_std
        contact_filter_kernels.correct(
            self._m,
            self._history,
            finger,
            frame.t_sample,
            estimate.d,
            estimate.tilt_x,
            estimate.tilt_y,
            estimate.gain,
            d_std * d_std,
            theta_std * theta_std,
        )

    def publish(self, t: float, contacts: list[Contact], pose: ObjectPose) -> None:
        """Write the estimates of time ``t`` into contacts and pose."""
        left, right = self._live
        pose.valid = held = left and right and self._with_object
        pose.angle = pose.width = 0.0
        if left or right:
            told = self.grasp.told
            contact_filter_kernels.tell(self._m, *self._tables, told)
            seen = told[: contact_filter_kernels.ANGLE_STD].tolist()
            if left:
                _fill_one(contacts[0], seen[: contact_filter_kernels.TIP_SIZE])
            if right:
                _fill_one(
                    contacts[1],
                    seen[contact_filter_kernels.TIP_SIZE : 2 * contact_filter_kernels.TIP_SIZE],
                )
            if held:
                pose.angle = seen[contact_filter_kernels.OBJECT_ANGLE]
                pose.width = seen[contact_filter_kernels.OBJECT_WIDTH]
        oldest = t - self._age_max
        for finger in self._fingers:
            contact = contacts[finger]
            fresh = contact.t_sound >= oldest
            contact.valid = fresh and self._sound[finger]
            if not fresh:
                pose.valid = False


def _fill_from_frame(contact: Contact, estimate: ContactEstimate, table: FloatArray) -> None:
    """Make ``contact`` what one frame's estimate says by itself, whatever the joints do.

    ``table``: the contact table's data.
    """
    contact.contact = estimate.contact
    contact.gain = estimate.gain
    contact.misfit = estimate.misfit
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
        table, contact.d, total_tilt(contact.theta, contact.tilt_y)
    )
    # A softer or stiffer tip than the table's shows as the gain of its whole pressure map.
    contact.force = contact.gain * force
    contact.energy = contact.gain * energy
    contact.inside = inside


def _fill_one(contact: Contact, told: list[float]) -> None:
    (
        contact.d,
        contact.theta,
        contact.force,
        contact.energy,
        _,
        contact.d_std,
        contact.theta_std,
        inside,
    ) = told
    contact.inside = inside > 0.0
