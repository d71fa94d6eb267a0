"""Contacts between the tactile frames: predicted from the joints each tick, corrected by frames.

A frame is exact but late and rare; joints are fresh but coarse. While an object is held, joint
motion carries d and the object's angle φ on by the rolling constraints (`kinematics.held`). A frame
is compared with what was predicted for the instant at which it was sampled, and the difference,
weighed by both variances, corrects the present. Holds this filter and nothing that acts on it.

A reading says only within which count a joint is: the tracked angle runs on with the measured
velocity and is held inside that count, so that it is exact at each count's edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from daemon.records import Contact, ObjectPose, Reading
from daemon.servos.registers import COUNTS_PER_TURN, VELOCITY_UNIT
from daemon.settings import Settings
from kinematics.held import held_motion, holding_levers, total_tilt
from kinematics.kernels import kernel
from kinematics.shear import load_by_torques
from kinematics.table import ContactTable, lookup

FloatArray = NDArray[np.float64]

_HISTORY = 0.5  # s of joint motion that are kept: frames older than that are taken as so old
_DRIFT_D = 1e-4  # m/√s, what d does by itself: the object shifts, the tip creeps
_DRIFT_ANGLE = 4e-3  # rad/√s, likewise
_SHARE = 0.05  # error of a predicted motion, as a share of it
_OUTLIER = 9.0  # variances off: the prediction was wrong, not the frame
_STEP_VARIANCE = 1.0 / 12.0  # of a count

# Places in the filter's memory; pairs are (left, right).
_B, _L, _E, _A, _COUNT, _ALONE = 0, 1, 2, 3, 4, 5
_T, _NEWEST = 6, 7
_Q, _D, _ANGLE = 8, 10, 12  # tracked joints [rad]; estimates [m], [rad]
_VAR = 13  # variances of d, d, φ just after a frame, drift added
_WAY = 16  # sums of predicted motion of d, d, φ
_SINCE = 19  # their lengths since the last frame's instant
_GAIN, _TILT, _LIVE = 22, 24, 26
_UNSEEN = 28  # motion of the joints since the last frame that the velocity can't show [rad]
_SLOW = 30  # half a count of velocity [rad/s]
_RAW = 31  # 1: frames as they are, carried on by nothing
_STRAY = 32  # sum of what frames have corrected of φ [rad]
_TORQUE = 33  # of the joints [N·m]
_MEMORY = 35

# Columns of the history, and of what a tick gives out.
_H_T, _H_WAY, _H_Q, _H_SIZE = 0, 1, 4, 6
_OUT = 31


@kernel
def _variance(m: FloatArray, which: int) -> float:
    """Variance of d1, d2 or φ: what the last frame left and what the joints may miss."""
    since = m[_SINCE + which]
    missed = _SHARE * since
    variance: float = m[_VAR + which] + missed * missed
    if since > 0.0:
        step = m[_COUNT] * (1.0 if which == 2 else m[_L])
        variance += min(since * since, _STEP_VARIANCE * step * step)
    return variance


@kernel
def _credited(m: FloatArray, finger: int, way: float, shown: float, dt: float) -> float:
    """What of a tracked joint's ``way`` the estimates have not felt yet.

    A joint that creeps through its count comes up by a whole one at the edge; frames have seen most
    of that on the way. Beyond the motion ``shown`` by the velocity only so much is new as may have
    stayed below half a count of velocity since the last frame.
    """
    unseen = m[_UNSEEN + finger] + m[_SLOW] * dt
    more = min(max(way - shown, -unseen), unseen)
    m[_UNSEEN + finger] = unseen - abs(more)
    credited: float = shown + more
    return credited


@kernel
def _advance(
    m: FloatArray, history: FloatArray, t: float, q1: float, q2: float, dq1: float, dq2: float
) -> None:
    """Carry the estimates on to time ``t`` by the joints' reading."""
    dt = t - m[_T]
    if dt <= 0.0:
        return
    m[_T] = t
    if dt > _HISTORY:
        dt = 0.0
        m[_Q] = q1
        m[_Q + 1] = q2
    half = 0.5 * m[_COUNT]
    way1 = min(max(m[_Q] + dq1 * dt, q1 - half), q1 + half) - m[_Q]
    way2 = min(max(m[_Q + 1] + dq2 * dt, q2 - half), q2 + half) - m[_Q + 1]
    seen1 = _credited(m, 0, way1, dq1 * dt, dt)
    seen2 = _credited(m, 1, way2, dq2 * dt, dt)
    both = m[_LIVE] > 0.0 and m[_LIVE + 1] > 0.0
    if (both or m[_ALONE] > 0.0) and m[_RAW] == 0.0:
        arm1, arm2, turn1, turn2, slide, _, _ = held_motion(
            m[_Q], m[_Q + 1], m[_D], m[_D + 1], m[_ANGLE], m[_B], m[_L], m[_E], m[_A]
        )
        if both:
            turn = turn1 * seen1 - turn2 * seen2
            deeper1 = deeper2 = 0.5 * (arm1 * seen1 + arm2 * seen2 + slide * turn)
        else:
            turn = 0.0
            deeper1 = arm1 * seen1 if m[_LIVE] > 0.0 else 0.0
            deeper2 = arm2 * seen2 if m[_LIVE + 1] > 0.0 else 0.0
        m[_D] += deeper1
        m[_D + 1] += deeper2
        m[_ANGLE] += turn
        m[_WAY] += deeper1
        m[_WAY + 1] += deeper2
        m[_WAY + 2] += turn
        m[_SINCE] += abs(deeper1)
        m[_SINCE + 1] += abs(deeper2)
        m[_SINCE + 2] += abs(turn)
    m[_Q] += way1
    m[_Q + 1] += way2
    m[_VAR] += _DRIFT_D * _DRIFT_D * dt
    m[_VAR + 1] += _DRIFT_D * _DRIFT_D * dt
    m[_VAR + 2] += _DRIFT_ANGLE * _DRIFT_ANGLE * dt
    newest = (int(m[_NEWEST]) + 1) % history.shape[0]
    m[_NEWEST] = newest
    history[newest, _H_T] = t
    for j in range(3):
        history[newest, _H_WAY + j] = m[_WAY + j]
    history[newest, _H_Q] = m[_Q]
    history[newest, _H_Q + 1] = m[_Q + 1]


@kernel
def _past(history: FloatArray, newest: int, t: float) -> tuple[int, int, float]:
    """Rows before and after time ``t``, and the later one's share; the ends for a time beyond."""
    size = history.shape[0]
    later = newest
    for back in range(size):
        row = (newest - back) % size
        if history[row, _H_T] == -math.inf:
            break  # nothing was read before: a frame may be older than the first reading
        if history[row, _H_T] <= t:
            span = history[later, _H_T] - history[row, _H_T]
            share = (t - history[row, _H_T]) / span if span > 0.0 else 0.0
            return row, later, share
        later = row
    return later, later, 0.0


@kernel
def _weigh(m: FloatArray, which: int, moved: float, found: float, variance: float) -> float:
    """Correct d1, d2 or φ by what a frame ``found``, ``moved`` ago by the joints; its weight."""
    own = _variance(m, which)
    place = _D + which  # φ stands behind both d
    miss = found - (m[place] - moved)
    if miss * miss > _OUTLIER * (own + variance):
        own = miss * miss
    weight = own / (own + variance) if m[_RAW] == 0.0 else 1.0
    m[place] += weight * miss
    m[_VAR + which] = weight * variance
    m[_SINCE + which] = abs(moved)
    return weight


@kernel
def _correct(
    m: FloatArray,
    history: FloatArray,
    finger: int,
    t: float,
    d: float,
    theta: float,
    tilt: float,
    gain: float,
    d_variance: float,
    theta_variance: float,
) -> None:
    """Take in one finger's frame of time ``t``."""
    row, later, share = _past(history, int(m[_NEWEST]), t)
    moved = m[_WAY + finger] - _between(history, row, later, share, _H_WAY + finger)
    turned = m[_WAY + 2] - _between(history, row, later, share, _H_WAY + 2)
    q = _between(history, row, later, share, _H_Q + finger)
    angle = theta - q if finger == 0 else theta + q
    step = m[_COUNT]
    m[_UNSEEN + finger] = min(m[_UNSEEN + finger], m[_SLOW] * max(m[_T] - t, 0.0))
    if m[_LIVE + finger] == 0.0:
        m[_D + finger] = d + moved
        m[_GAIN + finger] = gain
        m[_VAR + finger] = d_variance
        m[_SINCE + finger] = abs(moved)
        if m[_LIVE + 1 - finger] == 0.0:
            m[_ANGLE] = angle + turned
            m[_VAR + 2] = theta_variance
            m[_SINCE + 2] = abs(turned)
        m[_LIVE + finger] = 1.0
    else:
        # The errors of d and gain in a frame make up for each other: both get the same weight.
        weight = _weigh(m, finger, moved, d, d_variance)
        m[_GAIN + finger] += weight * (gain - m[_GAIN + finger])
        before = m[_ANGLE]
        _weigh(m, 2, turned, angle, theta_variance + _STEP_VARIANCE * step * step)
        m[_STRAY] += m[_ANGLE] - before
    m[_TILT + finger] = tilt


@kernel
def _between(history: FloatArray, row: int, later: int, share: float, column: int) -> float:
    first: float = history[row, column]
    last: float = history[later, column]
    return first + share * (last - first)


@kernel
def _tell(m: FloatArray, table1: FloatArray, table2: FloatArray, out: FloatArray) -> None:
    """Write what the estimates mean: see `Prediction.fill` for the order."""
    motion = held_motion(m[_Q], m[_Q + 1], m[_D], m[_D + 1], m[_ANGLE], m[_B], m[_L], m[_E], m[_A])
    theta1 = m[_ANGLE] + m[_Q]
    theta2 = m[_ANGLE] - m[_Q + 1]
    for finger in range(2):
        theta = theta1 if finger == 0 else theta2
        table = table1 if finger == 0 else table2
        force, energy, stiffness, _, _, _, inside = lookup(
            table, m[_D + finger], total_tilt(theta, m[_TILT + finger])
        )
        gain = m[_GAIN + finger]
        at = 7 * finger
        out[at] = max(m[_D + finger], 0.0)
        out[at + 1] = theta
        out[at + 2] = gain * force
        out[at + 3] = gain * energy
        out[at + 4] = gain * stiffness
        out[at + 5] = math.sqrt(_variance(m, finger))
        out[at + 6] = 1.0 if inside else 0.0
    out[14] = math.sqrt(_variance(m, 2))
    out[15] = m[_ANGLE]
    out[16] = motion[5]
    out[17] = motion[0]
    out[18] = motion[1]
    out[19] = motion[2]
    out[20] = motion[3]
    out[21] = motion[4]
    d1 = m[_D]
    d2 = m[_D + 1]
    lever1, lever2, shear, normal1, normal2 = holding_levers(
        table1, table2, d1, d2, theta1, theta2, motion
    )
    gain1 = m[_GAIN]
    gain2 = m[_GAIN + 1]
    out[22] = lever1
    out[23] = lever2
    out[24] = 2.0 * abs(shear) / (normal1 + normal2) if normal1 + normal2 > 0.0 else 0.0
    out[25] = m[_Q]
    out[26] = m[_Q + 1]
    out[27] = gain1 * normal1
    out[28] = gain2 * normal2
    if gain1 > 0.0 and gain2 > 0.0:
        torque1 = m[_TORQUE] / gain1
        torque2 = m[_TORQUE + 1] / gain2
        load, lever = load_by_torques(
            table1, table2, d1, d2, theta1, theta2, motion, shear, torque1, torque2
        )
        out[29] = 0.5 * (gain1 + gain2) * load
        out[30] = lever


def _pair() -> list[float]:
    return [0.0, 0.0]


@dataclass(slots=True)
class Held:
    """How the held object answers the joints: what a grip law needs. Pairs are (left, right)."""

    q: list[float] = field(default_factory=_pair)  # tracked joints [rad]
    arm: list[float] = field(default_factory=_pair)  # ∂(d1 + d2)/∂q, the force's lever [m]
    turn: list[float] = field(default_factory=_pair)  # φ̇ = turn1 q̇1 − turn2 q̇2
    slide: float = 0.0  # ∂(d1 + d2)/∂φ [m/rad]
    lever: list[float] = field(default_factory=_pair)  # torque over force by the energy [m]
    stiffness: list[float] = field(default_factory=_pair)  # ∂F/∂d [N/m]
    shear: float = 0.0  # shear over normal force, by the balance of the object without a load
    normal: list[float] = field(default_factory=_pair)  # normal forces [N]
    load: float = 0.0  # what each tip bears along its face, by the joints' torques [N]
    load_lever: float = 0.0  # and the lever of that load about the pivots [m]
    stray: float = 0.0  # turning of the object that no joint explains, summed up [rad]
    angle_std: float = 0.0  # of the object's angle [rad]


class Prediction:
    """The filter of one hand. Costs nothing but a comparison while no tip is touched."""

    def __init__(self, settings: Settings, tables: tuple[ContactTable, ContactTable]) -> None:
        """``tables``: what each tip feels, which may be of different materials."""
        hand = settings.hand
        self._with_object = settings.scene.object_model
        self._tables = tables[0].data, tables[1].data
        self._m = np.zeros(_MEMORY)
        self._m[: _COUNT + 2] = (
            0.5 * hand.pivot_separation,
            hand.finger_length,
            hand.finger_offset,
            settings.tip.radius,
            2.0 * math.pi / (COUNTS_PER_TURN * settings.servos.gear_ratio),
            float(len(settings.scene.fingers) == 1),
        )
        self._torque_constant = settings.control.torque_constant
        self._m[_SLOW] = 0.5 * VELOCITY_UNIT / settings.servos.gear_ratio
        self._m[_T] = -math.inf
        self._history = np.full((round(_HISTORY * settings.loop.rate) + 2, _H_SIZE), -math.inf)
        self._out = np.zeros(_OUT)
        self._live = [False, False]
        self.held = Held()

    def switch_off(self) -> None:
        """Pass frames on as they are, late and rare: to show what prediction is worth."""
        self._m[_RAW] = 1.0

    def advance(self, reading: Reading) -> None:
        """Carry the estimates on to the instant of a good reading."""
        q, dq, current = reading.q, reading.dq, reading.current
        self._m[_TORQUE] = self._torque_constant * current[0]
        self._m[_TORQUE + 1] = self._torque_constant * current[1]
        _advance(self._m, self._history, reading.t, q[0], q[1], dq[0], dq[1])

    def correct(self, finger: int, frame: Contact, contact: Contact) -> None:
        """Take in what was estimated from one finger's new ``frame``, and make it ``contact``."""
        if not frame.valid:
            # An unsound estimate is no news: the prediction goes on, and its age tells safety.
            contact.seq, contact.t, contact.t_arrival = frame.seq, frame.t, frame.t_arrival
            contact.valid = False
            return
        for name in Contact.__slots__:
            setattr(contact, name, getattr(frame, name))
        # Before a first reading nothing is known of the joints: the frame stands for itself.
        live = self._live[finger] = frame.contact and self._m[_T] > -math.inf
        if not live:
            self._m[_LIVE + finger] = self._m[_D + finger] = 0.0
            return
        _correct(
            self._m,
            self._history,
            finger,
            frame.t,
            frame.d,
            frame.theta,
            frame.tilt_y,
            frame.gain,
            frame.d_std * frame.d_std,
            frame.theta_std * frame.theta_std,
        )

    def fill(self, contacts: list[Contact], pose: ObjectPose) -> None:
        """Write the present estimates into the contacts that are made, and into the pose."""
        left, right = self._live
        pose.valid = False
        if not (left or right):
            pose.angle = pose.width = 0.0
            return
        _tell(self._m, *self._tables, self._out)
        out = self._out.tolist()
        angle_std = out[14]
        if left:
            _fill_one(contacts[0], out[0:7], angle_std)
        if right:
            _fill_one(contacts[1], out[7:14], angle_std)
        if left and right and self._with_object:
            pose.valid = True
            pose.angle = out[15]
            pose.width = out[16]
        else:
            pose.angle = pose.width = 0.0
        held = self.held
        held.arm = out[17:19]
        held.turn = out[19:21]
        held.slide = out[21]
        held.lever = out[22:24]
        held.q = out[25:27]
        held.stiffness = [out[4], out[11]]
        held.shear = out[24]
        held.normal = out[27:29]
        held.load = out[29]
        held.load_lever = out[30]
        held.stray = float(self._m[_STRAY])
        held.angle_std = angle_std


def _fill_one(contact: Contact, told: list[float], angle_std: float) -> None:
    contact.d, contact.theta, contact.force, contact.energy, _, contact.d_std, inside = told
    contact.theta_std = angle_std
    contact.inside = inside > 0.0
