"""The contact filter's state and kernels; `perception.contact_filter` explains the filter.

Pairs are (left, right). SI units.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import (
    Motion,
    Two,
    held_motion,
    holding_levers,
    load_torques,
    total_tilt,
)

FloatArray = NDArray[np.float64]
Tip = tuple[float, float, float, float, float, float, float, bool]  # of `write_grasp`

HISTORY = 0.5  # s of joint motion that are kept: an older frame is taken as so old
_DRIFT_D = 1e-4  # m/√s, what d does by itself: the object shifts, the tip creeps
_DRIFT_ANGLE = 4e-3  # rad/√s, likewise
_DRIFT_TAPER = 1e-3  # rad/√s, what the taper does: tips come to other parts of the faces
_TAPER_ERROR = 0.1  # rad that `object.taper` may be off
_SHARE = 0.05  # error of a predicted motion, as a share of it
_OUTLIER = 9.0  # variances off: the prediction was wrong, not the frame
_BY_TURNING = 0.8  # of such an angle's variance: the object turned, rather than tapers otherwise
_STEP_VARIANCE = 1.0 / 12.0  # of a count
LAW_POINTS = 17  # over d from 0 to the radius


class Quantity(Record):
    """A tip's d [m] or the object's angle φ [rad]: carried on by joints, corrected by frames."""

    mean: float
    variance: float  # just after the last frame, drift added
    way: float  # sum of predicted motion
    since: float  # its length since the last frame's instant


class TrackedTip(Record):
    """What the filter keeps of one tip and its joint."""

    d: Quantity
    gain: float
    tilt_y: float
    q: float  # tracked joint [rad]
    unseen: float  # joint motion since the last frame that the velocity can't show [rad]
    torque: float  # of the joint [N·m]
    covariance: Annotated[FloatArray, 3, 3]  # of (d, θ, gain) at the last frame
    shared: Pair  # the variances of d and θ in it that all frames share
    began: Pair  # the other ones, as the filter had them then
    law: Annotated[FloatArray, LAW_POINTS]  # relative error of F by table and law, over d
    live: bool  # touches, and is carried on


class GraspState(Record):
    """How the held object answers the joints at this tick: what a grip law needs."""

    t: float  # when the joints were read [s]
    d: Pair  # displacements [m]
    force: Pair  # of the tips, gain times their tables' [N]
    angle_std: float  # standard deviation of the object's angle [rad]
    taper: float  # α between the object's faces, as both tips feel them [rad]
    stray: float  # turning of the object that no joint explains, summed [rad]
    turning: float  # ∂U/∂θ over F θ d of the tips, upright: set once
    q: Pair  # tracked joints [rad]
    arm: Pair  # ∂(d1 + d2)/∂q, the force's lever [m]
    turn: Pair  # φ̇ = turn1 q̇1 − turn2 q̇2
    slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    lever: Pair  # torque over force by the energy [m]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # shear over normal force, by the object's balance, unloaded
    unexplained: Pair  # of the joints' torques, without a load along the faces [N·m]
    load_lever: float  # a load L makes them lever L + bow L²; 0: it shows nothing [m]
    load_bow: float  # [m/N]


class Past(Record):
    """Predicted motion until one instant: a row of the history."""

    t: float
    d: Pair
    angle: float
    q: Pair


class FilterState(Record):
    """What is set once, what the filter remembers, and what it finds."""

    half_separation: float  # of the hand, in m as its other lengths
    length: float
    offset: float
    radius: float
    count: float  # of a joint's encoder [rad]
    slow: float  # half a count of velocity [rad/s]
    torque_constant: float  # [N·m/A]
    assumed_taper: float  # `object.taper` [rad]
    alone: bool  # one finger
    t: float  # of the last reading [s]
    newest: int  # row of the history
    tip: Annotated[Records[TrackedTip], 2]
    angle: Quantity
    taper: float  # α as found [rad]
    taper_variance: float
    taper_covariance: float  # with φ
    stray: float  # sum of what frames have corrected of φ [rad]
    grasp: GraspState


@inner_kernel
def _variance(quantity: Quantity, step: float) -> float:
    """What the last frame left, and what joints read in steps of ``step`` may miss since."""
    since = quantity.since
    missed = _SHARE * since
    variance: float = quantity.variance + missed * missed
    if since > 0.0:
        variance += min(since * since, _STEP_VARIANCE * step * step)
    return variance


@inner_kernel
def _face_variance(f: FilterState, sense: float) -> float:
    """Variance of the angle φ + sense α/2 of one face; ``sense`` is −1 for the left tip's."""
    angle = _variance(f.angle, f.count)
    return max(angle + sense * f.taper_covariance + 0.25 * f.taper_variance, 0.0)


@inner_kernel
def _assume_taper(f: FilterState, sense: float, angle: float, variance: float) -> None:
    """Take the taper that is assumed, where only the face of ``sense`` is known, by ``angle``."""
    spread = _TAPER_ERROR * _TAPER_ERROR
    f.taper = f.assumed_taper
    f.angle.mean = angle - 0.5 * sense * f.assumed_taper
    f.angle.variance = variance + 0.25 * spread
    f.taper_variance = spread
    f.taper_covariance = -0.5 * sense * spread


@inner_kernel
def _credited(tip: TrackedTip, slow: float, way: float, shown: float, dt: float) -> float:
    """What of a tracked joint's ``way`` the estimates have not felt yet.

    A joint that creeps through its count comes up by a whole one at the edge; frames have seen most
    of that on the way. Beyond the motion ``shown`` by the velocity only so much is new as may have
    stayed below half a count of velocity since the last frame.
    """
    unseen = tip.unseen + slow * dt
    more = min(max(way - shown, -unseen), unseen)
    tip.unseen = unseen - abs(more)
    return shown + more


@inner_kernel
def _move(quantity: Quantity, way: float) -> None:
    quantity.mean += way
    quantity.way += way
    quantity.since += abs(way)


@kernel
def advance(
    filters: Records[FilterState], history: Records[Past], t: float, q: Two, dq: Two, current: Two
) -> None:
    """Carry the estimates on to time ``t`` by the joints' reading [rad, rad/s, A]."""
    f = filters[0]
    left = f.tip[0]
    right = f.tip[1]
    left.torque = f.torque_constant * current[0]
    right.torque = f.torque_constant * current[1]
    dt = t - f.t
    if dt <= 0.0:
        return
    f.t = t
    if dt > HISTORY:
        dt = 0.0
        left.q = q[0]
        right.q = q[1]
    half = 0.5 * f.count
    way1 = min(max(left.q + dq[0] * dt, q[0] - half), q[0] + half) - left.q
    way2 = min(max(right.q + dq[1] * dt, q[1] - half), q[1] + half) - right.q
    seen1 = _credited(left, f.slow, way1, dq[0] * dt, dt)
    seen2 = _credited(right, f.slow, way2, dq[1] * dt, dt)
    both = left.live and right.live
    if both or f.alone:
        arm1, arm2, turn1, turn2, slide, _, _ = _motion(f)
        if both:
            turn = turn1 * seen1 - turn2 * seen2
            deeper1 = deeper2 = 0.5 * (arm1 * seen1 + arm2 * seen2 + slide * turn)
        else:
            turn = 0.0
            deeper1 = arm1 * seen1 if left.live else 0.0
            deeper2 = arm2 * seen2 if right.live else 0.0
        _move(left.d, deeper1)
        _move(right.d, deeper2)
        _move(f.angle, turn)
    left.q += way1
    right.q += way2
    left.d.variance += _DRIFT_D * _DRIFT_D * dt
    right.d.variance += _DRIFT_D * _DRIFT_D * dt
    f.angle.variance += _DRIFT_ANGLE * _DRIFT_ANGLE * dt
    f.taper_variance += _DRIFT_TAPER * _DRIFT_TAPER * dt
    f.newest = (f.newest + 1) % len(history)
    row = history[f.newest]
    row.t = t
    row.angle = f.angle.way
    for k in range(2):
        row.d[k] = f.tip[k].d.way
        row.q[k] = f.tip[k].q


@inner_kernel
def _motion(f: FilterState) -> Motion:
    q = f.tip[0].q, f.tip[1].q
    d = f.tip[0].d.mean, f.tip[1].d.mean
    lengths = f.half_separation, f.length, f.offset, f.radius
    return held_motion(q, d, f.angle.mean, f.taper, lengths)


@inner_kernel
def _rows_at(history: Records[Past], newest: int, t: float) -> tuple[int, int, float]:
    """Rows before and after time ``t``, and the later one's share; the ends for a time beyond."""
    size = len(history)
    later = newest
    for back in range(size):
        row = (newest - back) % size
        if history[row].t == -math.inf:
            break  # nothing was read before: a frame may be older than the first reading
        if history[row].t <= t:
            span = history[later].t - history[row].t
            share = (t - history[row].t) / span if span > 0.0 else 0.0
            return row, later, share
        later = row
    return later, later, 0.0


@inner_kernel
def _weigh(quantity: Quantity, step: float, moved: float, found: float, variance: float) -> float:
    """Correct d by what a frame ``found``, ``moved`` ago by the joints; the frame's weight."""
    own = _variance(quantity, step)
    miss = found - (quantity.mean - moved)
    if miss * miss > _OUTLIER * (own + variance):
        own = miss * miss
    weight = own / (own + variance)
    quantity.mean += weight * miss
    quantity.variance = weight * variance
    quantity.since = abs(moved)
    return weight


@inner_kernel
def _weigh_angle(
    f: FilterState, sense: float, turned: float, found: float, variance: float
) -> None:
    """Correct φ and α by the angle of one face that a frame ``found``, ``turned`` ago."""
    own = _variance(f.angle, f.count)
    joint = f.taper_covariance
    spread = f.taper_variance
    miss = found - (f.angle.mean + 0.5 * sense * f.taper - turned)
    if miss * miss > _OUTLIER * (_face_variance(f, sense) + variance):
        own += _BY_TURNING * miss * miss
        spread += 4.0 * (1.0 - _BY_TURNING) * miss * miss
    by_angle = own + 0.5 * sense * joint
    by_taper = joint + 0.5 * sense * spread
    inverse = 1.0 / (by_angle + 0.5 * sense * by_taper + variance)
    f.angle.mean += by_angle * inverse * miss
    f.taper += by_taper * inverse * miss
    f.angle.variance = own - by_angle * by_angle * inverse
    f.taper_covariance = joint - by_angle * by_taper * inverse
    f.taper_variance = spread - by_taper * by_taper * inverse
    f.angle.since = abs(turned)


@kernel
def correct(
    filters: Records[FilterState],
    history: Records[Past],
    finger: int,
    t: float,
    found: tuple[float, float, float, float],
    covariance: FloatArray,
    systematic: FloatArray,
) -> None:
    """Take in one finger's frame of time ``t``: d, θ, tilt_y and gain, and their covariance.

    ``systematic`` is the part of it that all frames share: it is no reason to wait for more.
    """
    f = filters[0]
    tip = f.tip[finger]
    other = f.tip[1 - finger]
    d, theta, tilt_y, gain = found
    d_std = math.sqrt(covariance[0, 0] - systematic[0, 0])
    theta_std = math.sqrt(covariance[1, 1] - systematic[1, 1])
    d_variance = d_std * d_std
    row, later, share = _rows_at(history, f.newest, t)
    before = history[row]
    after = history[later]
    moved = tip.d.way - _between(before.d[finger], after.d[finger], share)
    turned = f.angle.way - _between(before.angle, after.angle, share)
    q = _between(before.q[finger], after.q[finger], share)
    angle = theta - q if finger == 0 else theta + q
    sense = -1.0 if finger == 0 else 1.0
    angle_variance = theta_std * theta_std + _STEP_VARIANCE * f.count * f.count
    tip.unseen = min(tip.unseen, f.slow * max(f.t - t, 0.0))
    tip.tilt_y = tilt_y
    if not tip.live:
        tip.live = True
        tip.d.mean = d + moved
        tip.d.variance = d_variance
        tip.d.since = abs(moved)
        tip.gain = gain
        if not other.live:
            _assume_taper(f, sense, angle + turned, angle_variance)
            f.angle.since = abs(turned)
        else:
            face = f.angle.mean - 0.5 * sense * f.taper
            _assume_taper(f, -sense, face, _face_variance(f, -sense))
            _weigh_angle(f, sense, turned, angle, angle_variance)
        _keep_covariance(f, finger, 1.0, covariance, systematic)
        return
    # The errors of d and gain in a frame make up for each other: both get the same weight.
    weight = _weigh(tip.d, f.count * f.length, moved, d, d_variance)
    tip.gain += weight * (gain - tip.gain)
    predicted = f.angle.mean
    _weigh_angle(f, sense, turned, angle, angle_variance)
    f.stray += f.angle.mean - predicted
    _keep_covariance(f, finger, weight, covariance, systematic)


@inner_kernel
def _keep_covariance(
    f: FilterState, finger: int, weight: float, covariance: FloatArray, systematic: FloatArray
) -> None:
    """What a frame of this ``weight`` leaves of the covariance of (d, θ, gain)."""
    tip = f.tip[finger]
    for i in range(3):
        row = i if i < 2 else 3
        for j in range(3):
            column = j if j < 2 else 3
            shared = systematic[row, column]
            tip.covariance[i, j] = weight * (covariance[row, column] - shared) + shared
    tip.shared[0] = systematic[0, 0]
    tip.shared[1] = systematic[1, 1]
    tip.began[0] = tip.d.variance
    tip.began[1] = _face_variance(f, -1.0 if finger == 0 else 1.0)


@inner_kernel
def _force_variance(
    tip: TrackedTip, slopes: tuple[float, float, float], grown: Two, share: float
) -> float:
    """Variance of F by its ``slopes`` in (d, θ, gain), ``grown`` that of d and θ since the frame.

    F is the third slope times the gain; ``share`` is d over the tip's radius.
    """
    total: float = 0.0
    for i in range(3):
        for j in range(3):
            total += slopes[i] * tip.covariance[i, j] * slopes[j]
    for i in range(2):
        total += slopes[i] * slopes[i] * max(grown[i] - tip.began[i], 0.0)
    t = min(max(share, 0.0), 1.0) * (LAW_POINTS - 1.001)
    k = int(t)
    law: float = tip.law[k] + (t - k) * (tip.law[k + 1] - tip.law[k])
    return total + (law * tip.gain * slopes[2]) ** 2


@inner_kernel
def _between(first: float, last: float, share: float) -> float:
    return first + share * (last - first)


@inner_kernel
def _write_tip(f: FilterState, finger: int, theta: float, table: FloatArray) -> Tip:
    tip = f.tip[finger]
    grasp = f.grasp
    tilt = total_tilt(theta, tip.tilt_y)
    force, energy, stiffness, by_tilt, _, _, inside = lookup(table, tip.d.mean, tilt)
    grasp.q[finger] = tip.q
    grasp.d[finger] = max(tip.d.mean, 0.0)
    # A softer or stiffer tip than the table's shows as the gain of its whole pressure map.
    grasp.force[finger] = tip.gain * force
    grasp.stiffness[finger] = tip.gain * stiffness
    d_variance = _variance(tip.d, f.count * f.length)
    theta_variance = _face_variance(f, -1.0 if finger == 0 else 1.0)
    along = theta / tilt if tilt > 0.0 else 0.0
    force_variance = _force_variance(
        tip,
        (tip.gain * stiffness, tip.gain * by_tilt * along, force),
        (d_variance, theta_variance),
        tip.d.mean / f.radius,
    )
    return (
        grasp.d[finger],
        theta,
        grasp.force[finger],
        tip.gain * energy,
        math.sqrt(d_variance + tip.shared[0]),
        math.sqrt(theta_variance + tip.shared[1]),
        math.sqrt(force_variance),
        inside,
    )


@kernel
def write_grasp(
    filters: Records[FilterState], table1: FloatArray, table2: FloatArray
) -> tuple[Tip, Tip, float, float]:
    """Write what the estimates mean into ``grasp``.

    Returns d, θ, force, energy, the standard deviations of d, θ and the force, and whether they are
    inside the table, for each tip; then the object's angle [rad] and width [m].
    """
    f = filters[0]
    grasp = f.grasp
    left = f.tip[0]
    right = f.tip[1]
    taper = f.taper
    angle = f.angle.mean
    motion = _motion(f)
    theta1 = angle - 0.5 * taper + left.q
    theta2 = angle + 0.5 * taper - right.q
    seen1 = _write_tip(f, 0, theta1, table1)
    seen2 = _write_tip(f, 1, theta2, table2)
    grasp.t = f.t
    grasp.angle_std = math.sqrt(_variance(f.angle, f.count))
    grasp.taper = taper
    grasp.stray = f.stray
    arm1, arm2, turn1, turn2, grasp.slide, width, _ = motion
    grasp.arm[0] = arm1
    grasp.arm[1] = arm2
    grasp.turn[0] = turn1
    grasp.turn[1] = turn2
    d = left.d.mean, right.d.mean
    theta = theta1, theta2
    lever1, lever2, shear, normal1, normal2 = holding_levers(
        table1, table2, d, theta, taper, motion
    )
    out_of_grip = 0.5 * math.tan(0.5 * taper) * (normal1 + normal2)
    grasp.lever[0] = lever1
    grasp.lever[1] = lever2
    grasp.shear = 0.0
    if normal1 + normal2 > 0.0:
        grasp.shear = 2.0 * (abs(shear) + abs(out_of_grip)) / (normal1 + normal2)
    grasp.normal[0] = left.gain * normal1
    grasp.normal[1] = right.gain * normal2
    if left.gain > 0.0 and right.gain > 0.0:
        rolled = (shear - out_of_grip, shear + out_of_grip)
        torques = left.torque / left.gain, right.torque / right.gain
        left1, left2, grasp.load_lever, bow = load_torques(
            table1, table2, d, theta, taper, motion, rolled, torques
        )
        grasp.unexplained[0] = left.gain * left1
        grasp.unexplained[1] = right.gain * left2
        grasp.load_bow = 2.0 * bow / (left.gain + right.gain)
    return seen1, seen2, angle, width
