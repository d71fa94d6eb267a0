"""Update the hand's state with the angle, footprint and amplitude channels of a tactile frame.

Channel     Measures                                                   Noise
angle       φ ∓ α/2 ± ENCODER + ANGLE_BIAS − θ̇ LATENCY                 frame covariance
footprint   D + D_BIAS − ḋ LATENCY; with an unknown gain:              frame covariance
            ln F(D, θ) + MODULUS + GAIN − (∂ ln F/∂d) ḋ LATENCY
amplitude   MODULUS + GAIN, if the gain was fitted                     2 %, frame covariance

A frame shows the hand at the time when the sensor scanned the cells. Each frame is therefore
compared with the state at the scan time, which is computed from the joint history.
`estimate.systematic` is the covariance of the errors that all frames share. The systematic
covariance is not part of the measurement noise and only increases the published standard
deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.grasp import AMPLITUDE, ANGLE_CHANNEL, FOOTPRINT
from softfinger.daemon.perception.hand_state import (
    AGREEMENT,
    ANGLE,
    ANGLE_BIAS,
    D_BIAS,
    ENCODER,
    FRICTION,
    GAIN,
    GATE,
    LATENCY,
    MODULUS,
    OUTLIER_GATE,
    STATES,
    TAPER,
    TORQUE,
    TORQUE_NOISE,
    D,
    HandFilter,
    HistoryRow,
    correct,
    interpolate,
    is_held,
    joint_angle,
    predicted_variance,
    reset,
    reset_all,
    settling_time,
    shift_sideways,
)
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import FloatPair, total_tilt

FloatArray = NDArray[np.float64]

D_MIN = 1e-5  # minimum displacement of a tip in contact [m]
# Smallest shift of a pressure image that counts as a fault [rad, or fraction of the tip radius]. A
# shift of 0.06 radii changes the measured angle by 0.06 rad. Without a shift, the angle error of a
# frame is at most 0.04 rad.
IMAGE_SHIFT_MIN = 0.06
_SLOPE_SMOOTHING = 0.9  # low-pass filter coefficient for ∂ ln F/∂d, applied on each frame
_AMPLITUDE_ERROR = 0.02  # relative error of the pressure model


class FrameContact(NamedTuple):
    """Contact estimated from one frame [m, rad, rad, -, N]."""

    d: float
    theta: float
    tilt_y: float
    gain: float
    shear: float


class Scan(NamedTuple):
    """Predicted motion of one finger since a scan, and the finger's state at the scan."""

    d: float  # change in d since the scan [m]
    q: float  # joint motion since the scan [rad]
    rotation: float  # object rotation since the scan [rad]
    d_rate: float  # at the scan [m/s]
    theta_rate: float  # at the scan [rad/s]
    pending_d: float  # standard deviation of d due to recent motion [m]
    pending_tilt: float  # standard deviation of the tilt due to recent motion [rad]
    relaxation: float  # relaxation factor


class FingerMotion(NamedTuple):
    """Predicted motion of one finger, accumulated up to a given time."""

    d: float
    pending_d: float
    pending_tilt: float
    angle: float
    q: float
    relaxation: float


@inner_kernel
def _sense(finger: int) -> float:
    """Return ∂θ/∂q of a tip: 1 for the left finger and −1 for the right finger."""
    return 1.0 - 2.0 * finger


@inner_kernel
def _motion_at(history: Records[HistoryRow], newest: int, t: float, finger: int) -> FingerMotion:
    """Interpolate the motion history at time ``t``; clamp ``t`` to the ends of the history."""
    size = len(history)
    before = after = newest
    fraction = 0.0
    for back in range(size):
        row = (newest - back) % size
        if history[row].t == -math.inf:  # The frame is older than all joint readings.
            before = after
            break
        before = row
        if history[row].t <= t:
            span = history[after].t - history[row].t
            fraction = (t - history[row].t) / span if span > 0.0 else 0.0
            break
        after = row
    first = history[before]
    last = history[after]
    return FingerMotion(
        interpolate(first.d[finger], last.d[finger], fraction),
        interpolate(first.pending_d[finger], last.pending_d[finger], fraction),
        interpolate(first.pending_tilt[finger], last.pending_tilt[finger], fraction),
        interpolate(first.angle, last.angle, fraction),
        interpolate(first.q[finger], last.q[finger], fraction),
        interpolate(first.relaxation[finger], last.relaxation[finger], fraction),
    )


@inner_kernel
def _rates(
    h: HandFilter, history: Records[HistoryRow], finger: int, scan: float
) -> tuple[float, float]:
    """Return the rates of d [m/s] and θ [rad/s] at the time ``scan``.

    The filter uses the rates as derivatives with respect to the latency. Each rate is averaged over
    ±1 standard deviation of the latency, because the joints may have stopped within this interval.
    The interval is at least one frame period. Rates below the velocity resolution are set to 0.
    """
    span_min = 0.5 / h.frame_rate
    span = max(math.sqrt(max(h.covariance[LATENCY, LATENCY], 0.0)), span_min)
    first = _motion_at(history, h.newest_row, scan - span, finger)
    end = min(scan + span, h.t)
    last = _motion_at(history, h.newest_row, end, finger)
    span = max(end - (scan - span), span_min)
    d_rate = (last.d - first.d) / span
    theta_rate = (last.angle - first.angle + _sense(finger) * (last.q - first.q)) / span
    if abs(d_rate) < h.velocity_unit * h.length:
        d_rate = 0.0
    if abs(theta_rate) < 2.0 * h.velocity_unit:
        theta_rate = 0.0
    return d_rate, theta_rate


@inner_kernel
def _motion_since(h: HandFilter, history: Records[HistoryRow], finger: int, t: float) -> Scan:
    """Return a finger's motion since the sensor scanned the frame with time stamp ``t``."""
    scan = t - h.mean[LATENCY]
    row = _motion_at(history, h.newest_row, scan, finger)
    d_rate, theta_rate = _rates(h, history, finger, scan)
    travel = h.tip[finger].travel
    return Scan(
        travel[0] - row.d,
        travel[1] - row.q,
        h.rotation - row.angle,
        d_rate,
        theta_rate,
        row.pending_d,
        row.pending_tilt,
        row.relaxation,
    )


@inner_kernel
def _set_angle_slopes(h: HandFilter, finger: int, theta_rate: float) -> None:
    h.slopes[ANGLE] = 1.0
    h.slopes[TAPER] = -0.5 * _sense(finger)
    h.slopes[ANGLE_BIAS + finger] = 1.0
    h.slopes[ENCODER + finger] = _sense(finger)
    h.slopes[LATENCY] = -theta_rate


@inner_kernel
def _set_d_slopes(
    h: HandFilter, finger: int, slope: float, bias_slope: float, d_rate: float
) -> None:
    h.slopes[D + finger] = slope
    h.slopes[D_BIAS + finger] = bias_slope
    h.slopes[LATENCY] = -slope * d_rate


@kernel
def update(
    hands: Records[HandFilter],
    history: Records[HistoryRow],
    finger: int,
    t: float,
    found: FrameContact,
    covariance: FloatArray,
    systematic: FloatArray,
    table: FloatArray,
) -> bool:
    """Update the state with one finger's frame from time ``t``; return False if it is rejected.

    ``covariance`` is the 4 × 4 covariance matrix of d, θ, tilt_y and gain. ``systematic`` is the
    part of ``covariance`` that all frames share. A gain variance above 0 means that the gain was
    fitted.
    """
    h = hands[0]
    tip = h.tip[finger]
    other = h.tip[1 - finger]
    if not _is_finite(h):
        tip.in_contact = other.in_contact = False
        h.grasp.unexplained_rotation[:] = 0.0
    d_noise = covariance[0, 0] - systematic[0, 0]
    theta_noise = covariance[1, 1] - systematic[1, 1]
    sense = _sense(finger)
    scan = _motion_since(h, history, finger, t)
    is_fitted = covariance[3, 3] > 0.0
    shows_d = is_fitted or h.gain_is_known
    tilt = total_tilt(found.theta, found.tilt_y)
    shown = lookup(table, found.d, tilt)
    log_slope = shown.force_d / shown.force
    d, gain = found.d, found.gain / scan.relaxation
    if h.gain_is_known:  # The amplitude determines d.
        d -= math.log(scan.relaxation) / log_slope
    q = joint_angle(h, finger) - scan.q  # joint angle at the scan [rad]
    face = found.theta - sense * q  # face angle at the scan [rad]
    is_new_contact = not tip.in_contact
    if is_new_contact:
        _begin_contact(h, finger, face + scan.rotation)
        reset(h, D + finger, d + scan.d, h.radius * h.radius)
    pending_variance = 0.0
    if shows_d:  # Otherwise, only frames during motion separate d from the gain.
        # All frames within `settling_time` have similar errors, so they count as one measurement.
        pending_variance = scan.pending_d**2 * max(h.frame_rate * settling_time(h), 1.0)
    d_noise += pending_variance
    d_at_scan = h.mean[D + finger] - scan.d
    angle_at_scan = h.mean[ANGLE] - 0.5 * sense * h.mean[TAPER] - scan.rotation
    angle_innovation = face - (angle_at_scan + h.mean[ANGLE_BIAS + finger])
    d_innovation = d - (d_at_scan + h.mean[D_BIAS + finger])
    if is_held(h) and min(h.grasp.normal[0], h.grasp.normal[1]) > h.contact_force:
        jump = (angle_innovation, d_innovation if is_fitted else 0.0)
        if _is_rejected(h, finger, scan, jump, (theta_noise, d_noise)):
            return False
    tip.tilt_y = found.tilt_y
    tip.gain_is_unknown = not shows_d
    tip.shear = found.shear
    tip.shared_variance[0] = systematic[0, 0]
    tip.shared_variance[1] = systematic[1, 1]
    if tip.gain_is_unknown:  # Subtract the gain error, because the filter estimates the gain.
        by_gain = h.prior_variance[GAIN + finger] ** 0.5 / log_slope
        tip.shared_variance[0] = max(systematic[0, 0] - by_gain * by_gain, 0.0)
    tip.has_new_frame = True
    _update_angle(h, finger, scan, angle_innovation, theta_noise, is_new_contact)
    tip.in_contact = True
    if tip.gain_is_unknown:
        expected = lookup(table, max(d_at_scan, D_MIN), tilt)
        smoothing = 0.0 if is_new_contact else _SLOPE_SMOOTHING
        tip.log_slope = interpolate(expected.force_d / expected.force, tip.log_slope, smoothing)
        innovation = math.log(shown.force / (scan.relaxation * expected.force))
        innovation -= h.mean[MODULUS + finger] + h.mean[GAIN + finger]
        _set_d_slopes(h, finger, tip.log_slope, 0.0, scan.d_rate)
        h.slopes[MODULUS + finger] = h.slopes[GAIN + finger] = 1.0
        _update_footprint(h, finger, innovation, d_noise * log_slope * log_slope)
    else:
        _set_d_slopes(h, finger, 1.0, 1.0, scan.d_rate)
        _update_footprint(h, finger, d_innovation, d_noise)
    if is_fitted and gain > 0.0:
        both_noise = covariance[0, 3] - systematic[0, 3]
        gain_noise = covariance[3, 3] - systematic[3, 3]
        noise = d_noise, both_noise, gain_noise
        _update_amplitude(h, finger, scan, (d, gain), noise, pending_variance)
    h.mean[D + finger] = max(h.mean[D + finger], D_MIN)
    return True


@inner_kernel
def _update_amplitude(
    h: HandFilter,
    finger: int,
    scan: Scan,
    found: FloatPair,
    noise: tuple[float, float, float],
    pending_variance: float,
) -> None:
    """Update the state with the amplitude of a frame.

    ``found`` is (d, gain). ``noise`` contains the variance of d including the pending motion, the
    covariance of d and gain, and the variance of gain. The noise excludes errors that all frames
    share. The errors of d and gain are correlated. The footprint update has already used the
    correlated part of the errors. The amplitude update therefore uses only the uncorrelated part.
    The relative amplitude error due to pending motion is as large as the relative error of d.
    """
    d, gain = found
    d_noise, both_noise, gain_noise = noise
    ratio = both_noise / (d_noise * gain)
    own_noise = max(gain_noise / (gain * gain) - ratio * ratio * d_noise, 0.0)
    own_noise += pending_variance / (d * d)
    d_residual = d - (h.mean[D + finger] - scan.d + h.mean[D_BIAS + finger])
    innovation = math.log(gain) - ratio * d_residual
    innovation -= h.mean[MODULUS + finger] + h.mean[GAIN + finger]
    _set_d_slopes(h, finger, -ratio, -ratio, scan.d_rate)
    h.slopes[MODULUS + finger] = h.slopes[GAIN + finger] = 1.0
    variance = own_noise + _AMPLITUDE_ERROR * _AMPLITUDE_ERROR
    correct(h, AMPLITUDE + finger, innovation, variance, GATE)


@inner_kernel
def _is_finite(h: HandFilter) -> bool:
    total = 0.0
    for state in range(STATES):
        total += abs(h.mean[state]) + h.covariance[state, state]
    return total < math.inf


@inner_kernel
def _begin_contact(h: HandFilter, finger: int, face: float) -> None:
    """Reset a finger's states on first contact.

    ``face`` is the angle of the object face in the first frame [rad]. If the other tip is not in
    contact, all states are reset.
    """
    for pair in (MODULUS, GAIN, TORQUE, D_BIAS, ANGLE_BIAS):
        state = pair + finger
        reset(h, state, h.prior_mean[state], h.prior_variance[state])
    h.grasp.rejects_frames[:] = 0.0
    h.tip[0].rejected_count = h.tip[1].rejected_count = 0
    h.tip[finger].d_innovation = 0.0
    if h.tip[1 - finger].in_contact:
        return
    reset_all(h)
    reset(h, ANGLE, face + 0.5 * _sense(finger) * h.mean[TAPER], h.prior_variance[ANGLE])
    for k in range(2):
        measured = h.grasp.free_torque[k]
        if measured > 0.0:
            h.mean[FRICTION] += 0.5 * (measured - h.prior_mean[FRICTION])
            h.covariance[FRICTION, FRICTION] *= 0.5
    # A load may already be acting on the object, so increase the friction variance.
    h.covariance[FRICTION, FRICTION] += TORQUE_NOISE * TORQUE_NOISE


@inner_kernel
def _update_angle(
    h: HandFilter,
    finger: int,
    scan: Scan,
    innovation: float,
    noise: float,
    is_new_contact: bool,
) -> None:
    """Update the state with the face angle measured in a frame.

    An innovation beyond the gate indicates that the object has rotated unexpectedly, unless the
    frame may lack a part of the joint motion.
    """
    before = h.mean[ANGLE] + h.mean[ANGLE_BIAS + finger]
    _set_angle_slopes(h, finger, scan.theta_rate)
    variance = predicted_variance(h) + noise + scan.pending_tilt**2
    if innovation * innovation > GATE * GATE * variance:
        h.covariance[ANGLE, ANGLE] += innovation * innovation
    correct(h, ANGLE_CHANNEL + finger, innovation, noise, math.inf)
    if not is_new_contact:
        rotation = h.mean[ANGLE] + h.mean[ANGLE_BIAS + finger] - before
        h.grasp.unexplained_rotation[finger] += rotation


@inner_kernel
def _update_footprint(h: HandFilter, finger: int, innovation: float, noise: float) -> None:
    """Update the state with the footprint channel, whose derivatives are in `slopes`.

    If the innovations of the two tips have opposite signs, a large innovation means that the object
    has been pushed sideways. If the signs are equal and the gain is unknown, a large innovation
    means that the sensor gain has changed.
    """
    d_innovation = innovation / h.slopes[D + finger]
    other = h.tip[1 - finger].d_innovation
    h.tip[finger].d_innovation = d_innovation
    if innovation * innovation > GATE * GATE * (predicted_variance(h) + noise):
        if d_innovation * other < 0.0:
            shift_sideways(h, min(abs(d_innovation), abs(other)) ** 2)
        elif h.tip[finger].gain_is_unknown:
            h.covariance[GAIN + finger, GAIN + finger] += innovation * innovation
    correct(h, FOOTPRINT + finger, innovation, noise, GATE)


@inner_kernel
def _is_rejected(h: HandFilter, finger: int, scan: Scan, jump: FloatPair, noise: FloatPair) -> bool:
    """Return True if a frame of a held object is an outlier, and count consecutive outliers.

    ``jump`` contains the innovations of angle and d, and ``noise`` contains the noise variances.
    A jump in angle or displacement is an outlier unless the other tip or the joints confirm the
    jump. A rotation is accepted if both tips show the rotation while the joints are moving. A
    displacement is accepted if the joints are moving or if both tips are displaced. A blow
    displaces both tips, because it presses the object into one tip and away from the other. The
    first frame of a real jump is also rejected, because the other tip's frame has not arrived yet.
    """
    grasp = h.grasp
    tip = h.tip[finger]
    other = 1 - finger
    _set_angle_slopes(h, finger, scan.theta_rate)
    angle_std = math.sqrt(predicted_variance(h) + noise[0])
    h.slopes[:] = 0.0
    _set_d_slopes(h, finger, 1.0, 1.0, scan.d_rate)
    d_std = math.sqrt(predicted_variance(h) + noise[1])
    h.slopes[:] = 0.0
    angle, d = jump
    angle_jumps = abs(angle) > max(2.0 * IMAGE_SHIFT_MIN, OUTLIER_GATE * angle_std)
    d_jumps = abs(d) > max(IMAGE_SHIFT_MIN * h.radius, OUTLIER_GATE * d_std)
    # The threshold is two velocity units per joint.
    joints_move = abs(tip.speed) + abs(h.tip[other].speed) > 4.0 * h.velocity_unit
    grasp.angle_jump[finger] = angle
    grasp.d_jump[finger] = d
    angle_agrees = angle * grasp.angle_jump[other] > AGREEMENT * angle * angle
    d_agrees = abs(grasp.d_jump[other]) >= AGREEMENT * abs(d)
    is_rejected: bool = (angle_jumps and not (angle_agrees and joints_move)) or (
        d_jumps and not (d_agrees or joints_move)
    )
    tip.rejected_count = tip.rejected_count + 1 if is_rejected else 0
    grasp.rejects_frames[finger] = 1.0 if tip.rejected_count >= h.rejected_max else 0.0
    return is_rejected
