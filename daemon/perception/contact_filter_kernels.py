"""The kernels that carry contacts on between frames and correct them, and their memory's layout.

Pure functions on one array; what they are for stands in :mod:`perception.contact_filter`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.external_load import load_by_torques
from softfinger.kinematics.hand.grasp_state import held_motion, holding_levers, total_tilt

FloatArray = NDArray[np.float64]

HISTORY = 0.5  # s of joint motion that are kept: frames older than that are taken as so old
_DRIFT_D = 1e-4  # m/√s, what d does by itself: the object shifts, the tip creeps
_DRIFT_ANGLE = 4e-3  # rad/√s, likewise
_DRIFT_TAPER = 1e-3  # rad/√s, what the taper does: tips come to other parts of the faces
_TAPER_OFF = 0.1  # rad that `object.taper` may be off
_SHARE = 0.05  # error of a predicted motion, as a share of it
_OUTLIER = 9.0  # variances off: the prediction was wrong, not the frame
_BY_TURNING = 0.8  # of such an angle's variance: the object turned, rather than tapers otherwise
_STEP_VARIANCE = 1.0 / 12.0  # of a count

# Places in the filter's memory; pairs are (left, right).
_B, _L, _E, _A, COUNT, _ALONE = 0, 1, 2, 3, 4, 5
T, _NEWEST = 6, 7
_Q, D, _ANGLE = 8, 10, 12  # tracked joints [rad]; estimates [m], [rad]
_VAR = 13  # variances of d, d, φ just after a frame, drift added
_WAY = 16  # sums of predicted motion of d, d, φ
_SINCE = 19  # their lengths since the last frame's instant
_GAIN, _TILT, LIVE = 22, 24, 26
_UNSEEN = 28  # motion of the joints since the last frame that the velocity can't show [rad]
SLOW = 30  # half a count of velocity [rad/s]
RAW = 31  # 1: frames as they are, carried on by nothing
STRAY = 32  # sum of what frames have corrected of φ [rad]
TORQUE = 33  # of the joints [N·m]
TAPER, TOLD = 35, 36  # α as found and as told [rad]
_TAPER_VAR, _TAPER_COV = 37, 38  # variance of α, covariance with φ
MEMORY = 39

# Columns of the history.
_H_T, _H_WAY, _H_Q, H_SIZE = 0, 1, 4, 6

# Places in what a tick is told; pairs are (left, right).
TIP_D, TIP_THETA, TIP_FORCE, TIP_ENERGY = 0, 1, 2, 3  # of the left tip; the right tip's follow
TIP_STIFFNESS, TIP_D_STD, TIP_THETA_STD, TIP_INSIDE = 4, 5, 6, 7
TIP_SIZE = 8
OBJECT_ANGLE, OBJECT_WIDTH, ANGLE_STD = 16, 17, 18
ARM, TURN, LEVER, JOINT, NORMAL = 19, 21, 23, 25, 27
SLIDE, OBJECT_TAPER, SHEAR, LOAD, LOAD_LEVER, STRAYED = 29, 30, 31, 32, 33, 34
TOLD_SIZE = 35


@inner_kernel
def _variance(m: FloatArray, which: int) -> float:
    """Variance of d1, d2 or φ: what the last frame left and what the joints may miss."""
    since = m[_SINCE + which]
    missed = _SHARE * since
    variance: float = m[_VAR + which] + missed * missed
    if since > 0.0:
        step = m[COUNT] * (1.0 if which == 2 else m[_L])
        variance += min(since * since, _STEP_VARIANCE * step * step)
    return variance


@inner_kernel
def _side_variance(m: FloatArray, sense: float) -> float:
    """Variance of the angle φ + sense α/2 of one face; ``sense`` is −1 for the left tip's."""
    variance: float = _variance(m, 2) + sense * m[_TAPER_COV] + 0.25 * m[_TAPER_VAR]
    return max(variance, 0.0)


@inner_kernel
def _free_taper(m: FloatArray, sense: float, angle: float, variance: float) -> None:
    """Take the taper as told, with only the face of ``sense`` known, by ``angle``."""
    spread = _TAPER_OFF * _TAPER_OFF
    m[TAPER] = m[TOLD]
    m[_ANGLE] = angle - 0.5 * sense * m[TOLD]
    m[_VAR + 2] = variance + 0.25 * spread
    m[_TAPER_VAR] = spread
    m[_TAPER_COV] = -0.5 * sense * spread


@inner_kernel
def _credited(m: FloatArray, finger: int, way: float, shown: float, dt: float) -> float:
    """What of a tracked joint's ``way`` the estimates have not felt yet.

    A joint that creeps through its count comes up by a whole one at the edge; frames have seen most
    of that on the way. Beyond the motion ``shown`` by the velocity only so much is new as may have
    stayed below half a count of velocity since the last frame.
    """
    unseen = m[_UNSEEN + finger] + m[SLOW] * dt
    more = min(max(way - shown, -unseen), unseen)
    m[_UNSEEN + finger] = unseen - abs(more)
    credited: float = shown + more
    return credited


@kernel
def advance(
    m: FloatArray, history: FloatArray, t: float, q1: float, q2: float, dq1: float, dq2: float
) -> None:
    """Carry the estimates on to time ``t`` by the joints' reading."""
    dt = t - m[T]
    if dt <= 0.0:
        return
    m[T] = t
    if dt > HISTORY:
        dt = 0.0
        m[_Q] = q1
        m[_Q + 1] = q2
    half = 0.5 * m[COUNT]
    way1 = min(max(m[_Q] + dq1 * dt, q1 - half), q1 + half) - m[_Q]
    way2 = min(max(m[_Q + 1] + dq2 * dt, q2 - half), q2 + half) - m[_Q + 1]
    seen1 = _credited(m, 0, way1, dq1 * dt, dt)
    seen2 = _credited(m, 1, way2, dq2 * dt, dt)
    both = m[LIVE] > 0.0 and m[LIVE + 1] > 0.0
    if (both or m[_ALONE] > 0.0) and m[RAW] == 0.0:
        arm1, arm2, turn1, turn2, slide, _, _ = held_motion(
            m[_Q],
            m[_Q + 1],
            m[D],
            m[D + 1],
            m[_ANGLE],
            m[TAPER],
            m[_B],
            m[_L],
            m[_E],
            m[_A],
        )
        if both:
            turn = turn1 * seen1 - turn2 * seen2
            deeper1 = deeper2 = 0.5 * (arm1 * seen1 + arm2 * seen2 + slide * turn)
        else:
            turn = 0.0
            deeper1 = arm1 * seen1 if m[LIVE] > 0.0 else 0.0
            deeper2 = arm2 * seen2 if m[LIVE + 1] > 0.0 else 0.0
        m[D] += deeper1
        m[D + 1] += deeper2
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
    m[_TAPER_VAR] += _DRIFT_TAPER * _DRIFT_TAPER * dt
    newest = (int(m[_NEWEST]) + 1) % history.shape[0]
    m[_NEWEST] = newest
    history[newest, _H_T] = t
    for j in range(3):
        history[newest, _H_WAY + j] = m[_WAY + j]
    history[newest, _H_Q] = m[_Q]
    history[newest, _H_Q + 1] = m[_Q + 1]


@inner_kernel
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


@inner_kernel
def _weigh(m: FloatArray, which: int, moved: float, found: float, variance: float) -> float:
    """Correct d1 or d2 by what a frame ``found``, ``moved`` ago by the joints; its weight."""
    own = _variance(m, which)
    place = D + which
    miss = found - (m[place] - moved)
    if miss * miss > _OUTLIER * (own + variance):
        own = miss * miss
    weight = own / (own + variance) if m[RAW] == 0.0 else 1.0
    m[place] += weight * miss
    m[_VAR + which] = weight * variance
    m[_SINCE + which] = abs(moved)
    return weight


@inner_kernel
def _weigh_angle(m: FloatArray, sense: float, turned: float, found: float, variance: float) -> None:
    """Correct φ and α by the angle of one face that a frame ``found``, ``turned`` ago."""
    if m[RAW] > 0.0:
        other = m[_ANGLE] - 0.5 * sense * m[TAPER]
        m[_ANGLE] = 0.5 * (found + other)
        m[TAPER] = sense * (found - other)
        m[_VAR + 2] = 0.5 * variance
        m[_TAPER_VAR] = 2.0 * variance
        m[_TAPER_COV] = 0.0
        m[_SINCE + 2] = abs(turned)
        return
    own = _variance(m, 2)
    joint = m[_TAPER_COV]
    spread = m[_TAPER_VAR]
    miss = found - (m[_ANGLE] + 0.5 * sense * m[TAPER] - turned)
    if miss * miss > _OUTLIER * (_side_variance(m, sense) + variance):
        own += _BY_TURNING * miss * miss
        spread += 4.0 * (1.0 - _BY_TURNING) * miss * miss
    by_angle = own + 0.5 * sense * joint
    by_taper = joint + 0.5 * sense * spread
    inverse = 1.0 / (by_angle + 0.5 * sense * by_taper + variance)
    m[_ANGLE] += by_angle * inverse * miss
    m[TAPER] += by_taper * inverse * miss
    m[_VAR + 2] = own - by_angle * by_angle * inverse
    m[_TAPER_COV] = joint - by_angle * by_taper * inverse
    m[_TAPER_VAR] = spread - by_taper * by_taper * inverse
    m[_SINCE + 2] = abs(turned)


@kernel
def correct(
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
    sense = -1.0 if finger == 0 else 1.0
    step = m[COUNT]
    angle_variance = theta_variance + _STEP_VARIANCE * step * step
    m[_UNSEEN + finger] = min(m[_UNSEEN + finger], m[SLOW] * max(m[T] - t, 0.0))
    if m[LIVE + finger] == 0.0:
        m[D + finger] = d + moved
        m[_GAIN + finger] = gain
        m[_VAR + finger] = d_variance
        m[_SINCE + finger] = abs(moved)
        if m[LIVE + 1 - finger] == 0.0:
            _free_taper(m, sense, angle + turned, angle_variance)
            m[_SINCE + 2] = abs(turned)
        else:
            other = m[_ANGLE] - 0.5 * sense * m[TAPER]
            _free_taper(m, -sense, other, _side_variance(m, -sense))
            _weigh_angle(m, sense, turned, angle, angle_variance)
        m[LIVE + finger] = 1.0
    else:
        # The errors of d and gain in a frame make up for each other: both get the same weight.
        weight = _weigh(m, finger, moved, d, d_variance)
        m[_GAIN + finger] += weight * (gain - m[_GAIN + finger])
        before = m[_ANGLE]
        _weigh_angle(m, sense, turned, angle, angle_variance)
        m[STRAY] += m[_ANGLE] - before
    m[_TILT + finger] = tilt


@inner_kernel
def _between(history: FloatArray, row: int, later: int, share: float, column: int) -> float:
    first: float = history[row, column]
    last: float = history[later, column]
    return first + share * (last - first)


@kernel
def tell(m: FloatArray, table1: FloatArray, table2: FloatArray, told: FloatArray) -> None:
    """Write what the estimates mean into ``told``."""
    taper = m[TAPER]
    d1 = m[D]
    d2 = m[D + 1]
    motion = held_motion(m[_Q], m[_Q + 1], d1, d2, m[_ANGLE], taper, m[_B], m[_L], m[_E], m[_A])
    theta1 = m[_ANGLE] - 0.5 * taper + m[_Q]
    theta2 = m[_ANGLE] + 0.5 * taper - m[_Q + 1]
    for finger in range(2):
        theta = theta1 if finger == 0 else theta2
        table = table1 if finger == 0 else table2
        force, energy, stiffness, _, _, _, inside = lookup(
            table, m[D + finger], total_tilt(theta, m[_TILT + finger])
        )
        gain = m[_GAIN + finger]
        tip = TIP_SIZE * finger
        told[tip + TIP_D] = max(m[D + finger], 0.0)
        told[tip + TIP_THETA] = theta
        told[tip + TIP_FORCE] = gain * force
        told[tip + TIP_ENERGY] = gain * energy
        told[tip + TIP_STIFFNESS] = gain * stiffness
        told[tip + TIP_D_STD] = math.sqrt(_variance(m, finger))
        told[tip + TIP_THETA_STD] = math.sqrt(_side_variance(m, -1.0 if finger == 0 else 1.0))
        told[tip + TIP_INSIDE] = 1.0 if inside else 0.0
        told[JOINT + finger] = m[_Q + finger]
    told[ANGLE_STD] = math.sqrt(_variance(m, 2))
    told[OBJECT_ANGLE] = m[_ANGLE]
    told[OBJECT_TAPER] = taper
    told[STRAYED] = m[STRAY]
    told[ARM], told[ARM + 1], told[TURN], told[TURN + 1], told[SLIDE], told[OBJECT_WIDTH], _ = (
        motion
    )
    lever1, lever2, shear, normal1, normal2 = holding_levers(
        table1, table2, d1, d2, theta1, theta2, taper, motion
    )
    out_of_grip = 0.5 * math.tan(0.5 * taper) * (normal1 + normal2)
    gain1 = m[_GAIN]
    gain2 = m[_GAIN + 1]
    told[LEVER] = lever1
    told[LEVER + 1] = lever2
    told[SHEAR] = 0.0
    if normal1 + normal2 > 0.0:
        told[SHEAR] = 2.0 * (abs(shear) + abs(out_of_grip)) / (normal1 + normal2)
    told[NORMAL] = gain1 * normal1
    told[NORMAL + 1] = gain2 * normal2
    if gain1 > 0.0 and gain2 > 0.0:
        torque1 = m[TORQUE] / gain1
        torque2 = m[TORQUE + 1] / gain2
        rolled = (shear - out_of_grip, shear + out_of_grip)
        load, lever = load_by_torques(
            table1, table2, d1, d2, theta1, theta2, taper, motion, rolled, torque1, torque2
        )
        told[LOAD] = 0.5 * (gain1 + gain2) * load
        told[LOAD_LEVER] = lever
