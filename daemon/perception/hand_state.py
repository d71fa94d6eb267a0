"""Define the hand's state, predict the state from joint motion, and update it with measurements.

`docs/estimation.md` describes the model and lists the manoeuvres that make each state observable.

State           Unit   Meaning                                      Changes due to
D               m      displacement of each tip                     joint motion, sideways shift
ENCODER         rad    true minus tracked joint angle               velocity resolution
D_BIAS          m      d bias in frames, e.g. from a zero offset    sensor warm-up
ANGLE_BIAS      rad    angle bias in frames                         image shift
MODULUS         –      ln of tip modulus relative to the settings   (constant in a grip)
GAIN            –      ln of sensor gain                            temperature
TORQUE          –      torque constant in the settings over the     (constant in a grip)
                       true one, minus 1
ANGLE           rad    angle of the object                          rolling
TAPER           rad    angle between the object faces               (constant in a grip)
LATENCY         s      frame age beyond `tactile.latency`           (constant in a grip)
FRICTION        N·m    mean joint torque not explained by the       random walk
                       grip force
PUSH            N      force on the object from left to right,      sudden sideways shift
                       across its faces

Each finger has its own states from D to TORQUE. Each name is the index for the left finger, and the
next index is for the right finger. All quantities are in SI units.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.grasp import ENCODER_CHANNEL, GraspState
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records
from softfinger.kinematics.hand.grasp_state import FloatPair, HeldMotion, Lengths, held_motion

FloatArray = NDArray[np.float64]

D, ENCODER, D_BIAS, ANGLE_BIAS, MODULUS, GAIN, TORQUE = range(0, 14, 2)
ANGLE, TAPER, LATENCY, FRICTION, PUSH, STATES = range(14, 20)

# Time span of the stored joint motion [s]. The assumed age of a frame is limited to HISTORY_TIME.
HISTORY_TIME = 0.5
LAW_POINTS = 17  # number of evenly spaced values of d from 0 to the tip radius

# Number of standard deviations beyond which innovations are down-weighted. Normally distributed
# noise exceeds it in one of 370 measurements.
GATE = 3.0
# Minimum deviation that counts as a fault, in standard deviations. Normally distributed noise
# exceeds it in one of 1.7 million frames, or every 2.4 hours with two sensors at 100 Hz.
OUTLIER_GATE = 5.0
# Minimum share of a change that both tips or joints must show to confirm it. If one tip is three
# times as stiff as the other, it shows a quarter of the change.
AGREEMENT = 0.25
# Relative error of the predicted motion and of the normal forces. For example, an error of 4 mm in
# the length of an 80 mm finger changes the predicted motion by 5 %.
MODEL_ERROR = 0.05
MODEL_ERROR_TIME = 0.1  # correlation time of the model error, an assumption [s]
# Torque noise of a moving joint [N·m], and random walk of FRICTION [N·m/√s]. Friction varies with
# position and time by as much as the default of `control.joint_friction`.
TORQUE_NOISE = 0.05

# Random walks [unit/√s]. The sizes are assumptions. They were tested with simulated sensors whose
# zero drifts by 5 % of full scale in 10 to 120 s (`softfinger bench robustness`).
_WALK_SIDEWAYS = 3e-4  # (d1 − d2)/2 in a grip [m]; the object can move between the tips
_WALK_SIDEWAYS_UNKNOWN_GAIN = 3e-5  # the same if frames measure only force × gain
_WALK_LOOSE_D = 5e-3  # d of a contact without a grip [m]
_WALK_LOOSE_ANGLE = 2e-2  # angle of a contact without a grip [rad]
_WALK_ANGLE = 2e-4  # angle in a grip, due to tip creep [rad]
_WALK_D_BIAS = 1e-4  # zero drift during sensor warm-up [m]
_WALK_ANGLE_BIAS = 1e-3  # shift of the pressure image [rad]
_WALK_GAIN = 0.05  # gain drift during sensor warm-up

_VELOCITY_TIME = 0.02  # correlation time of the velocity rounding error [s]
_VARIANCE_MIN = 1e-6  # minimum ratio of measurement variance to predicted variance
_CURRENT_ERROR = 0.25  # tolerated deviation of a current from its goal, as a fraction of the goal
_CURRENT_NOISE = 0.02  # additional tolerance for current noise [A]
_RELAXATION_MIN = 0.02  # lower bound of the relaxation factor


class TrackedTip(Record):
    """Per-finger data that is not part of the state vector."""

    in_contact: bool
    has_new_frame: bool  # True if a frame has arrived since the last update with joint torques
    gain_is_unknown: bool  # True if the frames measure force × gain instead of displacement
    rejected_count: int  # number of consecutive rejected frames
    current_off_time: float  # time since the current began to differ from its goal [s]
    tilt_y: float  # [rad]
    shear: float  # shear force in the hand plane, measured by a solid tip [N]
    log_slope: float  # ∂ ln F/∂d, low-pass filtered [1/m]
    d_innovation: float  # innovation of d in the newest frame [m]
    shared_variance: Pair  # variances of d and θ due to errors that all frames share
    q: float  # tracked joint angle [rad]
    encoder: float  # last encoder reading [rad]
    speed: float  # joint speed [rad/s]
    torque: float  # joint torque [N·m]
    free_torque: float  # average torque without contact [N·m]
    free_torque_max: Pair  # maximum |free_torque| in this window and in the previous window [N·m]
    window_start: float  # [s]
    travel: Pair  # accumulated predicted change in d [m] and in the joint angle [rad]
    delayed: Pair  # changes in d [m] and in the tilt [rad], low-pass filtered with `settling_time`
    law_error: Annotated[FloatArray, LAW_POINTS]  # relative error of F
    relaxation_state: Annotated[FloatArray, 3]  # low-pass filtered long-term forces [N]
    relaxation: float  # relaxation factor ρ, the ratio of tip force to long-term force


class HistoryRow(Record):
    """Predicted motion up to a given time, low-pass filtered with the cells' response time."""

    t: float
    d: Pair
    # Standard deviations of d [m] and of the tilt [rad] in a frame due to recent motion
    pending_d: Pair
    pending_tilt: Pair
    angle: float
    q: Pair
    relaxation: Pair


class HandFilter(Record):
    """Estimator state, covariance, constants and results."""

    mean: Annotated[FloatArray, STATES]
    covariance: Annotated[FloatArray, STATES, STATES]
    prior_mean: Annotated[FloatArray, STATES]  # means of the states before a contact
    prior_variance: Annotated[FloatArray, STATES]  # variances of the states before a contact
    slopes: Annotated[FloatArray, STATES]  # row of the measurement matrix, zero between updates
    scratch: Annotated[FloatArray, STATES]
    half_separation: float  # half the pivot separation [m]
    length: float  # finger length [m]
    offset: float  # fingertip offset [m]
    radius: float  # tip radius [m]
    encoder_resolution: float  # encoder resolution [rad]
    velocity_unit: float  # [rad/s]
    latency: float  # `tactile.latency` [s]
    frame_rate: float  # `tactile.rate` [Hz]
    # `safety.frame_age_fault` as a time [s]; also the time after which a wrong current is a fault
    frame_age_max: float
    rejected_max: float  # number of consecutive rejected frames that counts as a fault
    contact_force: float  # `control.contact_force` [N]
    response: float  # `tactile.response` [s]
    relaxation: Annotated[FloatArray, 3]  # `tip.relaxation`
    relaxation_time: Annotated[FloatArray, 3]  # `tip.relaxation_times` [s]
    torque_constant: float  # output torque per ampere of a closing joint [N·m/A]
    inertia: float  # joint inertia [kg·m²]
    load_held: float  # fraction of the tip moment that gear friction can balance
    is_single: bool  # True for a one-finger hand
    is_gripping: bool  # True from the start of an approach to the end of the grip
    gain_is_known: bool  # True if `estimator.free_gain` is false
    t: float  # time of the last reading [s]
    newest_row: int  # index of the newest row in the history
    rotation: float  # accumulated predicted rotation [rad]
    closing_speed: float  # mean closing speed of both joints [rad/s], low-pass filtered
    last_closing_speed: float  # value of `closing_speed` on the previous tick [rad/s]
    rest_time: float  # time for which the joints of this grip have not closed [s]
    balance_time: float  # time of the last update with joint torques and force balance [s]
    tip: Annotated[Records[TrackedTip], 2]
    grasp: GraspState


# --- update ---------------------------------------------------------------------------------------


@inner_kernel
def predicted_variance(h: HandFilter) -> float:
    """Return slopesᵀ P slopes and store P slopes in `scratch`; P is the covariance matrix."""
    expected = 0.0
    for i in range(STATES):
        total = 0.0
        for j in range(STATES):
            total += h.covariance[i, j] * h.slopes[j]
        h.scratch[i] = total
        expected += h.slopes[i] * total
    return max(expected, 0.0)


@inner_kernel
def correct(h: HandFilter, channel: int, innovation: float, variance: float, gate: float) -> None:
    """Update the state with one scalar measurement whose derivatives are in `slopes`.

    ``variance`` is the variance of the measurement noise. If the innovation exceeds ``gate``
    standard deviations, the noise variance is increased until the innovation equals ``gate``
    standard deviations. An innovation that is not finite is ignored. Finally, all slopes are set to
    0.

    `grasp.nis[channel]` is an exponential moving average of the normalised innovation squared. Each
    value in the average is limited to ``gate`` squared. The time constant of the average is
    ``frame_rate`` updates.
    """
    expected = predicted_variance(h)
    square = innovation * innovation
    nis = min(square / (expected + variance), gate * gate)
    if nis < math.inf:
        h.grasp.nis[channel] += (nis - h.grasp.nis[channel]) / h.frame_rate
    variance = max(variance, square / (gate * gate) - expected, _VARIANCE_MIN * expected)
    total = expected + variance
    if 0.0 < total < math.inf and abs(innovation) < math.inf:
        inverse = 1.0 / total
        for i in range(STATES):
            gain = h.scratch[i] * inverse
            h.mean[i] += gain * innovation
            for j in range(STATES):
                h.covariance[i, j] -= gain * h.scratch[j]
        h.mean[LATENCY] = max(h.mean[LATENCY], -h.latency)
    h.slopes[:] = 0.0


@inner_kernel
def reset(h: HandFilter, state: int, mean: float, variance: float) -> None:
    """Set the mean and variance of one state, and remove its correlation with the other states."""
    h.covariance[state, :] = 0.0
    h.covariance[:, state] = 0.0
    h.covariance[state, state] = variance
    h.mean[state] = mean


@inner_kernel
def reset_all(h: HandFilter) -> None:
    """Reset all states to their priors."""
    for state in range(STATES):
        reset(h, state, h.prior_mean[state], h.prior_variance[state])
    h.rest_time = 0.0


# --- prediction -----------------------------------------------------------------------------------


@inner_kernel
def joint_angle(h: HandFilter, finger: int) -> float:
    """Return the estimated angle of a joint [rad]."""
    angle: float = h.tip[finger].q + h.mean[ENCODER + finger]
    return angle


@inner_kernel
def motion_of(h: HandFilter) -> HeldMotion:
    """Return the Jacobian of the held object; see `hand.grasp_state.held_motion`."""
    q = joint_angle(h, 0), joint_angle(h, 1)
    d = h.mean[D], h.mean[D + 1]
    lengths = Lengths(h.half_separation, h.length, h.offset, h.radius)
    return held_motion(q, d, h.mean[ANGLE], h.mean[TAPER], lengths)


@inner_kernel
def _walk(h: HandFilter, state: int, per_root_second: float, dt: float) -> None:
    h.covariance[state, state] += per_root_second * per_root_second * dt


@inner_kernel
def _walk_d(h: HandFilter, common: float, opposite: float, dt: float) -> None:
    """Add process noise to both displacements.

    The ``common`` noise changes both displacements by the same amount. The ``opposite`` noise
    changes the two displacements by opposite amounts.
    """
    alike = common * common * dt
    other = opposite * opposite * dt
    h.covariance[D, D] += alike + other
    h.covariance[D + 1, D + 1] += alike + other
    h.covariance[D, D + 1] += alike - other
    h.covariance[D + 1, D] += alike - other


@inner_kernel
def shift_sideways(h: HandFilter, variance: float) -> None:
    """Add process noise for a sideways shift of the object between the tips.

    ``variance`` is the variance of the shift [m²]. A shift x towards the right finger changes d1 by
    −x and d2 by x. Only a push can shift an object that a grip holds. The push equals the change in
    F2 − F1, which is x times the sum of the tip stiffnesses.
    """
    h.scratch[:] = 0.0
    h.scratch[D] = -1.0
    h.scratch[D + 1] = 1.0
    if is_held(h):
        h.scratch[PUSH] = h.grasp.stiffness[0] + h.grasp.stiffness[1]
    for i in (D, D + 1, PUSH):
        for j in (D, D + 1, PUSH):
            h.covariance[i, j] += variance * h.scratch[i] * h.scratch[j]


@kernel
def predict(
    hands: Records[HandFilter],
    history: Records[HistoryRow],
    t: float,
    q: FloatPair,
    dq: FloatPair,
    current: FloatPair,
    goal: FloatPair,
    is_gripping: bool,
) -> None:
    """Predict the state at time ``t`` from a joint reading [rad, rad/s, A].

    ``goal`` is the current that a grip commands for each joint [A]. If a goal is 0, the measured
    current is used. ``is_gripping`` is True from the start of an approach to the end of the grip.
    """
    h = hands[0]
    if is_gripping and not h.is_gripping:  # An approach begins.
        for k in range(2):
            _restart_free_torque(h, k, t)
            if not h.tip[k].in_contact:
                h.grasp.free_torque[k] = 0.0
    h.is_gripping = is_gripping
    if not is_gripping:
        h.grasp.rejects_frames[:] = 0.0
        h.tip[0].rejected_count = h.tip[1].rejected_count = 0
    dt = t - h.t
    last_speed = h.tip[0].speed, h.tip[1].speed
    for k in range(2):
        h.tip[k].speed = dq[k]
    if dt <= 0.0:
        return
    for k in range(2):
        tip = h.tip[k]
        tip.torque = h.torque_constant * _check_current(h, k, current[k], goal[k], dt)
        if not tip.in_contact:
            _measure_free_torque(h, k, t, dt, dq[k] - last_speed[k])
    h.t = t
    if dt > HISTORY_TIME:  # After a long pause, use the encoder angles alone.
        dt = 0.0
        for k in range(2):
            h.tip[k].q = h.tip[k].encoder = q[k]
            reset(h, ENCODER + k, 0.0, h.prior_variance[ENCODER + k])
    h.last_closing_speed = h.closing_speed
    h.closing_speed += (0.5 * (dq[0] + dq[1]) - h.closing_speed) * min(dt / _VELOCITY_TIME, 1.0)
    _move(h, (dq[0] * dt, dq[1] * dt), dt)
    if h.tip[0].in_contact or h.tip[1].in_contact:
        _add_process_noise(h, dt)
    missing1 = _read_encoder(h, 0, q[0], abs(dq[0]) * dt)
    missing2 = _read_encoder(h, 1, q[1], abs(dq[1]) * dt)
    if missing1 != 0.0 or missing2 != 0.0:
        _move(h, (missing1, missing2), 0.0)
    for k in range(2):
        _relax(h, k, dt)
    _store(h, history, t, dt)


@inner_kernel
def _store(h: HandFilter, history: Records[HistoryRow], t: float, dt: float) -> None:
    """Low-pass filter the motion with the response time of the cells, and store the result."""
    smoothing = math.exp(-dt / h.response) if h.response > 0.0 else 0.0
    settling = math.exp(-dt / settling_time(h))
    last = history[h.newest_row]
    h.newest_row = (h.newest_row + 1) % len(history)
    row = history[h.newest_row]
    row.t = t
    row.angle = interpolate(h.rotation, last.angle, smoothing)
    for k in range(2):
        tip = h.tip[k]
        row.d[k] = interpolate(tip.travel[0], last.d[k], smoothing)
        tilt = h.rotation + (1.0 - 2.0 * k) * tip.travel[1]
        tip.delayed[0] = interpolate(tip.travel[0], tip.delayed[0], settling)
        tip.delayed[1] = interpolate(tilt, tip.delayed[1], settling)
        row.pending_d[k], row.pending_tilt[k] = _pending(
            h, tip.travel[0] - tip.delayed[0], tilt - tip.delayed[1]
        )
        row.q[k] = interpolate(tip.travel[1], last.q[k], smoothing)
        row.relaxation[k] = interpolate(tip.relaxation, last.relaxation[k], smoothing)


@inner_kernel
def settling_time(h: HandFilter) -> float:
    """Return the time [s] within which the cells follow the pressure.

    The cells may respond more slowly than `tactile.response` specifies. The unknown part is as
    large as the error of `tactile.latency`.
    """
    settling: float = h.response + math.sqrt(h.prior_variance[LATENCY])
    return settling


@inner_kernel
def _pending(h: HandFilter, closing: float, tilting: float) -> FloatPair:
    """Return the standard deviations of d [m] and of the tilt [rad] in a frame due to motion.

    A frame may lack an unknown part of the motion within `settling_time`, a change ``closing`` in d
    [m] and ``tilting`` in the tilt [rad]. Motion below the velocity resolution is ignored. If the
    tip rolls by ``tilting``, the pressure image smears by s = R ``tilting``, where R is the tip
    radius. Its mean square radius, which is 2Rd/3 for a parabolic pressure distribution, then
    increases by s². Therefore, d appears to be larger by 1.5 s²/R.
    """
    resolution = h.velocity_unit * settling_time(h)
    smear = 1.5 * h.radius * tilting * tilting
    d_std = math.hypot(max(abs(closing) - resolution * h.length, 0.0), smear)
    return d_std, max(abs(tilting) - 2.0 * resolution, 0.0)


@inner_kernel
def interpolate(first: float, last: float, fraction: float) -> float:
    """Interpolate linearly between ``first`` and ``last``."""
    return first + fraction * (last - first)


@inner_kernel
def _move(h: HandFilter, step: FloatPair, dt: float) -> None:
    """Advance the joints by ``step`` [rad] in ``dt`` seconds, and move the tips and the object.

    If both tips are in contact, the object rotates by r1 Δq1 − r2 Δq2, and each displacement
    changes by half the change in d1 + d2 (docs/estimation.md). Otherwise, the object is assumed to
    be at rest, and each joint moves only its own tip.
    """
    left = h.tip[0]
    right = h.tip[1]
    motion = motion_of(h)
    arm1, arm2 = motion.moment_arm
    r1, r2 = motion.rolling_ratio
    # Before contact, the gap shrinks at the rate at which d grows during contact.
    both = left.in_contact and right.in_contact
    by1, by2 = arm1, arm2
    if both:
        by1 = 0.5 * (arm1 + motion.slide * r1)
        by2 = 0.5 * (arm2 - motion.slide * r2)
    else:
        r1 = r2 = 0.0
    step1, step2 = step
    d_step1 = by1 * step1
    d_step2 = by2 * step2
    if both:
        d_step1 = d_step2 = d_step1 + d_step2
    rotation = r1 * step1 - r2 * step2
    left.q += step1
    right.q += step2
    left.travel[1] += step1
    right.travel[1] += step2
    # An impossible step, for example due to a taper of 180°, would corrupt the state permanently.
    if not abs(d_step1) + abs(d_step2) + abs(rotation) * h.radius < h.radius:
        return
    left.travel[0] += d_step1
    right.travel[0] += d_step2
    h.rotation += rotation
    if left.in_contact:
        h.mean[D] += d_step1
    if right.in_contact:
        h.mean[D + 1] += d_step2
    h.mean[ANGLE] += rotation
    if dt > 0.0:
        # All motion within MODEL_ERROR_TIME has the same error.
        relative = MODEL_ERROR * math.sqrt(max(MODEL_ERROR_TIME / dt, 1.0))
        if both:
            # In a rotation, the fingers move in opposite directions, so their errors do not cancel.
            apart = motion.across + 2.0 * h.radius - h.mean[D] - h.mean[D + 1]
            closing_error = relative * math.hypot(d_step1, 0.5 * apart * rotation)
            _walk_d(h, closing_error, relative * (arm1 * step1 - arm2 * step2), 1.0)
            _walk(h, ANGLE, relative * rotation, 1.0)
        else:
            _walk(h, D, relative * d_step1, 1.0)
            _walk(h, D + 1, relative * d_step2, 1.0)
    _add_rounding_noise(h, 0, by1, r1, both, dt)
    _add_rounding_noise(h, 1, by2, -r2, both, dt)


@inner_kernel
def _add_rounding_noise(
    h: HandFilter, finger: int, by: float, turn: float, both: bool, dt: float
) -> None:
    """Add process noise for the rounding of a joint's velocity.

    A joint angle error of 1 rad changes d by ``by`` [m] and φ by ``turn`` [rad]. If ``both`` tips
    are in contact, the error changes both displacements.
    """
    variance = h.velocity_unit * h.velocity_unit / 12.0 * _VELOCITY_TIME * dt
    h.scratch[:] = 0.0
    h.scratch[ENCODER + finger] = 1.0
    h.scratch[ANGLE] = turn
    for i in range(2):
        if i == finger or both:
            h.scratch[D + i] = by
    for i in (D, D + 1, ENCODER + finger, ANGLE):
        for j in (D, D + 1, ENCODER + finger, ANGLE):
            h.covariance[i, j] += variance * h.scratch[i] * h.scratch[j]


@inner_kernel
def is_held(h: HandFilter) -> bool:
    """Return True if all fingers grip an object.

    While an object is held, the distance between its faces is constant. Without a grip, an object
    that presses on the tips may move freely.
    """
    both: bool = h.tip[0].in_contact and h.tip[1].in_contact
    return h.is_gripping and (both or h.is_single)


@inner_kernel
def _add_process_noise(h: HandFilter, dt: float) -> None:
    """Add the process noise for ``dt`` seconds of contact."""
    if is_held(h):
        # The object has a constant width, so only the joints change d1 + d2.
        sideways = _WALK_SIDEWAYS
        if h.tip[0].gain_is_unknown and h.tip[1].gain_is_unknown:
            sideways = _WALK_SIDEWAYS_UNKNOWN_GAIN
        _walk_d(h, 0.0, 0.0 if h.is_single else sideways, dt)
        _walk(h, ANGLE, _WALK_ANGLE, dt)
        for k in range(2):
            _walk(h, D_BIAS + k, _WALK_D_BIAS, dt)
            _walk(h, ANGLE_BIAS + k, _WALK_ANGLE_BIAS, dt)
    else:
        _walk_d(h, _WALK_LOOSE_D, _WALK_LOOSE_D, dt)
        _walk(h, ANGLE, _WALK_LOOSE_ANGLE, dt)
    _walk(h, FRICTION, TORQUE_NOISE, dt)
    if is_held(h) and h.closing_speed <= h.velocity_unit:
        h.rest_time += dt
    for k in range(2):
        _walk(h, GAIN + k, _WALK_GAIN, dt)


@inner_kernel
def _read_encoder(h: HandFilter, finger: int, q: float, step: float) -> float:
    """Update the state with the encoder angle.

    Return the correction [rad] that moves the tracked angle back into the measured encoder count,
    or 0 if the tracked angle is within the count.

    The angle is known precisely only when the encoder count changes. Between two changes, the angle
    is uncertain by one count. ``step`` is the joint motion since the last reading [rad], computed
    from the joint velocity.
    """
    tip = h.tip[finger]
    found, spread = _encoder_measurement(h, finger, q, step)
    tip.encoder = q
    if spread == 0.0:
        return 0.0
    h.slopes[ENCODER + finger] = 1.0
    innovation = found - joint_angle(h, finger)
    correct(h, ENCODER_CHANNEL + finger, innovation, spread * spread / 12.0, math.inf)
    tip.q += h.mean[ENCODER + finger]
    h.mean[ENCODER + finger] = 0.0
    if abs(q - tip.q) > 0.5 * h.encoder_resolution:
        return _edge(h, q, q - tip.q) - tip.q
    return 0.0


@inner_kernel
def _edge(h: HandFilter, q: float, direction: float) -> float:
    """Return the lower edge [rad] of the count ``q`` if ``direction`` > 0, else the upper edge."""
    return q - math.copysign(0.5 * h.encoder_resolution, direction)


@inner_kernel
def _encoder_measurement(h: HandFilter, finger: int, q: float, step: float) -> tuple[float, float]:
    """Return the joint angle and the width of its uniform error distribution [rad].

    A width of 0 means that the reading contains no new information.
    """
    tip = h.tip[finger]
    resolution = h.encoder_resolution
    jump = q - tip.encoder
    if abs(jump) > 0.5 * resolution:
        # The joint has crossed an edge between two encoder counts since the last reading. After a
        # jump of several counts, the joint angle is known only to within one count.
        spread = max(step, 0.05 * resolution) if abs(jump) < 1.5 * resolution else resolution
        return _edge(h, q, jump), spread
    if abs(q - tip.q) > 0.5 * resolution:  # The tracked angle lies outside the measured count.
        return _edge(h, q, q - tip.q), resolution
    # Measure the angle anew if its variance is twice that of a uniform error within one count.
    if h.covariance[ENCODER + finger, ENCODER + finger] > resolution * resolution / 6.0:
        return q, resolution
    return q, 0.0


@inner_kernel
def _measure_free_torque(
    h: HandFilter, finger: int, t: float, dt: float, speed_change: float
) -> None:
    """Measure the friction of a joint as the maximum torque during free motion.

    Readings from the last `frame_age_max` seconds are excluded, because the frames may not yet show
    a contact that has already begun. The start of an approach discards earlier measurements.
    Without a new approach, an earlier measurement is discarded once the tip has been free for
    `frame_age_max` seconds, because a light contact may be lost for a moment.
    """
    tip = h.tip[finger]
    accelerating = h.inertia * speed_change / dt
    weight = min(dt / _VELOCITY_TIME, 1.0)
    tip.free_torque += (tip.torque - accelerating - tip.free_torque) * weight
    tip.free_torque_max[0] = max(tip.free_torque_max[0], abs(tip.free_torque))
    if t - tip.window_start > h.frame_age_max:
        if tip.free_torque_max[1] == 0.0:  # This is the first window of an approach.
            h.grasp.free_torque[finger] = 0.0
        h.grasp.free_torque[finger] = max(h.grasp.free_torque[finger], tip.free_torque_max[1])
        tip.free_torque_max[1] = tip.free_torque_max[0]
        tip.free_torque_max[0] = 0.0
        tip.window_start = t


@inner_kernel
def _restart_free_torque(h: HandFilter, finger: int, t: float) -> None:
    """Discard the unfinished friction measurement of a joint."""
    tip = h.tip[finger]
    tip.free_torque = 0.0
    tip.free_torque_max[:] = 0.0
    tip.window_start = t


@inner_kernel
def _check_current(h: HandFilter, finger: int, current: float, goal: float, dt: float) -> float:
    """Return a joint's ``goal`` current during a grip, otherwise the measured ``current`` [A].

    If the measured current deviates from ``goal`` for too long, set `grasp.has_wrong_current`.
    """
    tip = h.tip[finger]
    is_off = goal > 0.0 and abs(current - goal) > _CURRENT_ERROR * goal + _CURRENT_NOISE
    tip.current_off_time = tip.current_off_time + dt if is_off else 0.0
    h.grasp.has_wrong_current[finger] = 1.0 if tip.current_off_time > h.frame_age_max else 0.0
    return goal if goal > 0.0 else current


@inner_kernel
def _relax(h: HandFilter, finger: int, dt: float) -> None:
    """Advance a tip's Prony series by ``dt`` seconds, and compute the relaxation factor."""
    tip = h.tip[finger]
    lasting = h.grasp.force[finger] / tip.relaxation if tip.in_contact else 0.0
    if not lasting < math.inf:  # The force is not finite outside the range of the material law.
        lasting = 0.0
    factor = 1.0
    for k in range(3):
        strength = h.relaxation[k]
        if strength == 0.0:
            continue
        weight = -math.expm1(-dt / h.relaxation_time[k])
        tip.relaxation_state[k] += (lasting - tip.relaxation_state[k]) * weight
        factor += strength * (1.0 - tip.relaxation_state[k] / lasting if lasting > 0.0 else 1.0)
    tip.relaxation = max(factor, _RELAXATION_MIN)
