"""Compute the grasp, and update the state with the joint torques and the force balance.

Channel   Measures                                                         Noise
torque    mean of (1 + TORQUE) × tip force moment + FRICTION + inertia,    0.05 N·m and torque
          in the first force ramp                                          held by the gears
balance   N1 + PUSH = N2 as a ratio, where N are the normal forces         5 % and 0.4 N

The force on a tip is ρ e^MODULUS F(D, θ). F is the tip's contact table, and ρ is the tip's
relaxation factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.frame_channels import IMAGE_SHIFT_MIN
from softfinger.daemon.perception.grasp import BALANCE, TORQUES
from softfinger.daemon.perception.hand_state import (
    ANGLE,
    ANGLE_BIAS,
    D_BIAS,
    ENCODER,
    FRICTION,
    GAIN,
    GATE,
    LAW_POINTS,
    MODEL_ERROR,
    MODEL_ERROR_TIME,
    MODULUS,
    OUTLIER_GATE,
    PUSH,
    TAPER,
    TORQUE,
    TORQUE_NOISE,
    D,
    HandFilter,
    TrackedTip,
    correct,
    interpolate,
    is_held,
    joint_angle,
    motion_of,
    predicted_variance,
)
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import (
    FloatPair,
    HeldMotion,
    holding_forces,
    load_torques,
    total_tilt,
)

FloatArray = NDArray[np.float64]

# Friction force between object and table [N], for example of 0.1 kg with a coefficient of 0.4.
_SUPPORT_FRICTION = 0.4
_D_BIAS_MIN = 0.1  # fraction of d
_PAUSE_MAX = 0.3  # total time without closing after which the first force ramp has ended [s]


class TipResult(NamedTuple):
    """Estimates for one tip and their standard deviations [m, rad, N, J]."""

    d: float
    theta: float
    force: float
    energy: float
    d_std: float
    theta_std: float
    force_std: float
    inside: bool  # True if d and θ lie within the range of the contact table


class GraspResult(NamedTuple):
    """Estimates for both tips, and the object's angle [rad] and width [m]."""

    left: TipResult
    right: TipResult
    angle: float
    width: float


@inner_kernel
def _log_slope(h: HandFilter, finger: int) -> float:
    """Return ∂ ln F/∂d [1/m] for a tip.

    If the gain is unknown, the slope of the footprint channel is returned. If two channels used
    different slopes, unobservable directions of the state would appear observable.
    """
    tip = h.tip[finger]
    slope: float = tip.log_slope
    if not tip.gain_is_unknown:
        slope = h.grasp.stiffness[finger] / max(h.grasp.force[finger], 1e-3)
    return slope


@inner_kernel
def _set_torque_slopes(h: HandFilter) -> float:
    """Return the mean joint torque [N·m] due to the tip forces; set its derivatives in `slopes`.

    Each joint contributes (1 + TORQUE) M, where M is the moment of the tip force about the joint. M
    equals the joint torque divided by (1 + TORQUE), minus the torque residual. M is proportional to
    the tip force ρ e^MODULUS F(D, θ). Therefore, ∂M/∂MODULUS = M and ∂M/∂D = M ∂ ln F/∂d.
    """
    expected = 0.0
    for k in range(2):
        scale = 1.0 + h.mean[TORQUE + k]
        moment = h.tip[k].torque / scale - h.grasp.torque_residual[k]
        expected += 0.5 * scale * moment
        h.slopes[TORQUE + k] = 0.5 * moment
        h.slopes[MODULUS + k] = 0.5 * scale * moment
        h.slopes[D + k] = 0.5 * scale * moment * _log_slope(h, k)
    return expected


@inner_kernel
def _update_by_torques(h: HandFilter, dt: float) -> None:
    """Update the state with the mean closing torque and with the balance of the normal forces."""
    torque = 0.5 * (h.tip[0].torque + h.tip[1].torque)
    innovation = torque - h.mean[FRICTION] - _set_torque_slopes(h)
    # Friction opposes the closing motion. After the first force ramp, loads may act, too.
    if h.closing_speed > h.velocity_unit and h.rest_time < _PAUSE_MAX:
        innovation -= h.inertia * (h.closing_speed - h.last_closing_speed) / dt
        h.slopes[FRICTION] = 1.0
        held_torque = h.load_held * torque  # torque that gear friction may balance
        variance = TORQUE_NOISE * TORQUE_NOISE + held_torque * held_torque
        correct(h, TORQUES, innovation, variance, GATE)
    h.slopes[:] = 0.0
    normal = h.grasp.normal
    normal_min = min(normal[0], normal[1])
    if normal_min > 0.0 and h.t > h.balance_time:
        push = h.mean[PUSH]
        rightward = normal[0] + max(push, 0.0)
        leftward = normal[1] + max(-push, 0.0)
        h.slopes[MODULUS] = normal[0] / rightward
        h.slopes[MODULUS + 1] = -normal[1] / leftward
        for k in range(2):
            h.slopes[D + k] = h.slopes[MODULUS + k] * _log_slope(h, k)
        h.slopes[PUSH] = 1.0 / rightward if push > 0.0 else 1.0 / leftward
        error = MODEL_ERROR + _SUPPORT_FRICTION / normal_min
        variance = error * error * max(MODEL_ERROR_TIME / (h.t - h.balance_time), 1.0)
        correct(h, BALANCE, math.log(leftward / rightward), variance, GATE)
    h.balance_time = h.t


@inner_kernel
def _relative_law_error(tip: TrackedTip, fraction: float) -> float:
    """Return the relative error of the tip force at ``fraction`` = d/radius."""
    t = min(max(fraction, 0.0), 1.0) * (LAW_POINTS - 1.001)
    k = int(t)
    return interpolate(tip.law_error[k], tip.law_error[k + 1], t - k)


@inner_kernel
def _modulus(h: HandFilter, finger: int) -> float:
    """Return the ratio of a tip's force to the force in its contact table."""
    return math.exp(h.mean[MODULUS + finger]) * h.tip[finger].relaxation


@inner_kernel
def _write_tip(h: HandFilter, finger: int, theta: float, table: FloatArray) -> TipResult:
    tip = h.tip[finger]
    grasp = h.grasp
    tilt = total_tilt(theta, tip.tilt_y)
    d = h.mean[D + finger]
    found = lookup(table, d, tilt)
    modulus = _modulus(h, finger)
    force = modulus * found.force
    stiffness = modulus * found.force_d
    grasp.q[finger] = tip.q
    grasp.d[finger] = max(d, 0.0)
    grasp.force[finger] = force
    grasp.stiffness[finger] = stiffness
    h.slopes[D + finger] = stiffness
    h.slopes[MODULUS + finger] = force
    by_state = predicted_variance(h)
    h.slopes[:] = 0.0
    h.slopes[ANGLE] = 1.0
    h.slopes[TAPER] = finger - 0.5
    h.slopes[ENCODER + finger] = 1.0 - 2.0 * finger
    theta_variance = predicted_variance(h) + tip.shared_variance[1]
    h.slopes[:] = 0.0
    d_shared = tip.shared_variance[0]
    law = _relative_law_error(tip, d / h.radius) * force
    by_angle = modulus * found.force_theta * (theta / tilt if tilt > 0.0 else 0.0)
    force_variance = by_state + stiffness * stiffness * d_shared
    force_variance += by_angle * by_angle * theta_variance + law * law
    return TipResult(
        grasp.d[finger],
        theta,
        force,
        modulus * found.energy,
        math.sqrt(max(h.covariance[D + finger, D + finger], 0.0) + d_shared),
        math.sqrt(theta_variance),
        math.sqrt(force_variance),
        found.inside,
    )


@kernel
def write_grasp(hands: Records[HandFilter], table1: FloatArray, table2: FloatArray) -> GraspResult:
    """Compute the grasp from the current state, then update the state with the joint torques."""
    h = hands[0]
    grasp = h.grasp
    left = h.tip[0]
    right = h.tip[1]
    taper = h.mean[TAPER]
    angle = h.mean[ANGLE]
    motion = motion_of(h)
    theta = angle - 0.5 * taper + joint_angle(h, 0), angle + 0.5 * taper - joint_angle(h, 1)
    result1 = _write_tip(h, 0, theta[0], table1)
    result2 = _write_tip(h, 1, theta[1], table2)
    dt = h.t - grasp.t
    grasp.t = h.t
    grasp.angle_std = math.sqrt(max(h.covariance[ANGLE, ANGLE], 0.0))
    grasp.slide = motion.slide
    for k in range(2):
        grasp.moment_arm[k] = motion.moment_arm[k]
        grasp.rolling_ratio[k] = motion.rolling_ratio[k]
    _write_load(h, table1, table2, theta, motion)
    _write_shear(h)
    has_new_frame = left.has_new_frame or right.has_new_frame
    if has_new_frame and is_held(h) and not h.is_single and dt > 0.0:
        left.has_new_frame = right.has_new_frame = False
        if grasp.load_arm > 0.0:
            _update_by_torques(h, dt)
    _write_consistency(h)
    return GraspResult(result1, result2, angle, motion.width)


@inner_kernel
def _write_load(
    h: HandFilter, table1: FloatArray, table2: FloatArray, theta: FloatPair, motion: HeldMotion
) -> None:
    """Write the normal forces, the shear at equilibrium, and the torques attributed to a load."""
    grasp = h.grasp
    taper = h.mean[TAPER]
    d = h.mean[D], h.mean[D + 1]
    held = holding_forces(table1, table2, d, theta, taper, motion)
    shear = held.shear
    normal = held.normal[0] + held.normal[1]
    by_taper = 0.5 * math.tan(0.5 * taper) * normal
    grasp.shear = 0.0
    if normal > 0.0:
        grasp.shear = 2.0 * (abs(shear) + abs(by_taper)) / normal
    modulus1 = _modulus(h, 0)
    modulus2 = _modulus(h, 1)
    torque1 = h.tip[0].torque / (1.0 + h.mean[TORQUE])
    torque2 = h.tip[1].torque / (1.0 + h.mean[TORQUE + 1])
    load = load_torques(
        table1,
        table2,
        d,
        theta,
        taper,
        motion,
        (shear - by_taper, shear + by_taper),
        (torque1 / modulus1, torque2 / modulus2),
    )
    grasp.load_arm = load.arm
    grasp.load_curvature = 2.0 * load.curvature / (modulus1 + modulus2)
    for k in range(2):
        modulus = modulus1 if k == 0 else modulus2
        grasp.energy_arm[k] = held.energy_arm[k]
        grasp.normal[k] = modulus * held.normal[k]
        grasp.torque_residual[k] = modulus * load.residual[k]


@inner_kernel
def _write_shear(h: HandFilter) -> None:
    """Split the shear of solid tips into a pulling part and a twisting part.

    A pull shears the two tips in opposite directions. A twist shears both tips in the same
    direction.
    """
    left = h.tip[0].shear
    right = h.tip[1].shear
    common = math.copysign(min(abs(left), abs(right)), left)
    h.grasp.pull_shear = common if left * right < 0.0 else 0.0
    h.grasp.twist_shear = common - h.grasp.pull_shear


@inner_kernel
def _write_consistency(h: HandFilter) -> None:
    """Write the channel biases, and set `sensor_fault` if a channel is faulty."""
    grasp = h.grasp
    grasp.sensor_fault = False
    for k in range(2):
        grasp.d_bias[k] = h.mean[D_BIAS + k]
        grasp.angle_bias[k] = h.mean[ANGLE_BIAS + k]
        grasp.gain_change[k] = h.mean[GAIN + k] - h.prior_mean[GAIN + k]
        grasp.gain_std[k] = math.sqrt(max(h.covariance[GAIN + k, GAIN + k], 0.0))
        has_d_bias = _has_bias(h, D_BIAS, k, _D_BIAS_MIN * grasp.d[k])
        has_angle_bias = _has_bias(h, ANGLE_BIAS, k, IMAGE_SHIFT_MIN)
        grasp.has_d_bias[k] = 1.0 if has_d_bias else 0.0
        grasp.has_angle_bias[k] = 1.0 if has_angle_bias else 0.0
        if has_d_bias or has_angle_bias or grasp.rejects_frames[k] or grasp.has_wrong_current[k]:
            grasp.sensor_fault = True


@inner_kernel
def _has_bias(h: HandFilter, pair: int, finger: int, smallest: float) -> bool:
    """Return True if a sensor's bias is significant and exceeds ``smallest``.

    A bias in one sensor also causes a smaller apparent bias in the other sensor. Only the sensor
    with the larger bias has a significant bias.
    """
    size = abs(h.mean[pair + finger])
    std = math.sqrt(max(h.covariance[pair + finger, pair + finger], 0.0))
    is_larger = size >= abs(h.mean[pair + 1 - finger])
    is_significant: bool = is_larger and size > max(smallest, OUTLIER_GATE * std)
    return is_significant and h.grasp.d[finger] > 0.0
