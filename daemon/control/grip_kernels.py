"""Define the state and the kernels of the grip control laws; see `control.grip`.

The kernels receive the controller state, the grasp state of this tick, and the averaging windows of
the setpoints. Pairs are ordered (left, right). All quantities are in SI units.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.control import setpoint, slip_monitor
from softfinger.daemon.control.setpoint import SetpointState
from softfinger.daemon.control.slip_monitor import SlipState, clip, mean
from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.hand_state import GATE
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records
from softfinger.kinematics.hand.grasp_state import Lengths
from softfinger.kinematics.hand.upright import upright_spring

FloatArray = NDArray[np.float64]

# Force margin, in standard deviations of the torque constant; covers 95 % of all servos.
_TORQUE_ERROR_SIGMA = 2.0
_DISTRIBUTE_BANDWIDTH = 2.0  # bandwidth of the controller that equalises the tip forces [Hz]
# Tolerance of the object angle [rad]. The noise of simulated sensors is 0.5 to 2 mrad (1 σ).
ANGLE_TOLERANCE = math.radians(0.5)
_STIFFNESS_MIN = 100.0  # lower limit of the stiffness, which is used as a divisor [N/m]
ROTATION_MIN = 0.1  # minimum ratio of object rotation to antisymmetric joint angle


class GripLaw(Record):
    """Constants of the grip control laws."""

    dt: float  # [s]
    force_gain: float
    force_bandwidth: float  # [rad/s]
    rotate_bandwidth: float  # [rad/s]
    rotate_speed: float  # [rad/s]
    damping: float  # 2 ζ √J, the ratio of the damping [N·m·s/rad] to √stiffness
    joint_friction: float  # [N·m]
    driving: float  # motor torque divided by tip torque while a joint closes
    friction_speed: float  # joint speed above which friction is fully compensated [rad/s]
    torque_error: float  # relative error of the torque constants
    turn_decay: float  # factor that reduces the rotation rate on each tick without a frame
    is_blind: bool  # True for the `upright` law, which uses dither until a target angle is set
    half_separation: float  # half the pivot separation [m]
    length: float  # finger length [m]
    offset: float  # fingertip offset [m]
    radius: float  # tip radius [m]
    dither_torque: float  # [N·m]
    dither_rate: float  # [rad/s]
    dither_time: float  # duration of the dither, whose amplitude falls to 0 [s]


class GripState(Record):
    """Commanded values and internal state of the grip control laws."""

    law: GripLaw
    force: SetpointState  # mean tip force [N]
    angle: SetpointState  # object angle [rad]
    slip: SlipState
    commanded: float  # commanded force [N]
    force_rate: float  # [N/s]
    joint_stiffness: float  # [N·m/rad]
    is_steering: bool  # True if a target has been set for the object angle
    integral: float  # [N]
    grip_force: float  # sum of feed-forward and feedback force [N]
    offset_rate: float  # rate of change of `offset` [rad/s]
    offset: float  # goal for (q1 − q2)/2 [rad]
    dither_elapsed: float  # time since the dither began [s]
    last_time: float  # time of the last call to `_equal_torques` or `start` [s]
    balance_offset: float  # part of `offset` that equalises the tip forces [rad]
    closing_friction: float  # fraction of the joint friction that is compensated during closing
    torque: Pair  # most recent torques of both joints [N·m]


@kernel
def start(
    grips: Records[GripState],
    grasps: Records[GraspState],
    force_windows: FloatArray,
    measured: float,
) -> None:
    """Begin the grip at the ``measured`` force [N]."""
    g = grips[0]
    q = grasps[0].q
    slip_monitor.reset(g.slip)
    setpoint.reset(g.force, force_windows, measured)
    g.integral = g.balance_offset = g.closing_friction = g.dither_elapsed = 0.0
    g.offset = 0.5 * (q[0] - q[1])
    g.is_steering = False
    g.last_time = grasps[0].t


@kernel
def begin_holding(grips: Records[GripState], grasps: Records[GraspState]) -> None:
    """Mark the grip as settled so that loads can be detected."""
    slip_monitor.begin(grips[0].slip, grasps[0])


@kernel
def grip_torques(
    grips: Records[GripState],
    grasps: Records[GraspState],
    force_windows: FloatArray,
    angle_windows: FloatArray,
    angle: float,
    dq: tuple[float, float],
    holding: bool,
) -> tuple[float, float]:
    """Return both joint torques [N·m].

    ``angle`` is the object angle [rad], or NaN if the angle is unknown. ``dq`` contains the joint
    velocities [rad/s]. ``holding`` is True in a settled grip, in which only loads move the joints.
    """
    g = grips[0]
    grasp = grasps[0]
    g.force.target = slip_monitor.update(
        g.slip,
        grasp,
        g.commanded,
        holding,
        g.closing_friction,
        dq,
        g.torque,
    )
    if g.slip.reflex_triggered and g.force.target > g.force.value:
        setpoint.reset(g.force, force_windows, g.force.target)
    target = setpoint.advance(g.force, force_windows, g.force_rate)
    target = min(target, g.slip.balanced_max)
    load_torque = grasp.load_arm * g.slip.load
    limit = _force_limit(g, mean(grasp.moment_arm), mean(grasp.free_torque), load_torque)
    g.grip_force = _grip_force(g, target, mean(grasp.force), limit)
    g.offset_rate = 0.0
    if g.is_steering:
        g.offset_rate = _steer(g, angle_windows, grasp, angle)
    is_upright = g.law.is_blind and not g.is_steering
    is_turning = g.is_steering and not setpoint.has_arrived(g.angle)
    if setpoint.has_arrived(g.force) and not (is_upright or is_turning):
        _distribute(g, grasp)
    closing_rate = _closing_rate(g, grasp, g.force.speed)
    g.closing_friction = clip(closing_rate / g.law.friction_speed, 1.0)
    if is_upright:
        return _equal_torques(g, grasp, target, closing_rate, dq)
    return _torques(g, grasp, closing_rate, dq)


@kernel
def hold_goal(
    grips: Records[GripState], grasps: Records[GraspState], dq: tuple[float, float]
) -> tuple[float, float]:
    """Return joint torques [N·m] that hold the force and stop a rotation if frames are late.

    Call this kernel instead of :func:`grip_torques`.
    """
    g = grips[0]
    g.offset_rate *= g.law.turn_decay
    g.offset += g.offset_rate * g.law.dt
    return _torques(g, grasps[0], _closing_rate(g, grasps[0], 0.0), dq)


@kernel
def single_torque(
    grips: Records[GripState],
    grasps: Records[GraspState],
    force_windows: FloatArray,
    finger: int,
    dq: float,
    frames_late: bool,
) -> float:
    """Return the torque [N·m] for one ``finger`` that presses on a supported object.

    If ``frames_late`` is True, the force stays constant.
    """
    g = grips[0]
    grasp = grasps[0]
    arm = grasp.moment_arm[finger]
    stiffness = max(grasp.stiffness[finger], _STIFFNESS_MIN)
    closing_rate = 0.0
    if not frames_late:
        target = setpoint.advance(g.force, force_windows, g.force_rate)
        # The supported object can't move, so friction at the tip may balance part of the torque.
        q, law = grasp.q[finger], g.law
        reach = law.length * math.sin(q) + law.offset * math.cos(q) + law.radius
        held_torque = g.slip.law.tip_friction * g.force.target * max(reach, 0.0)
        limit = _force_limit(g, arm, grasp.free_torque[finger], held_torque)
        g.grip_force = _grip_force(g, target, grasp.force[finger], limit)
        closing_rate = g.force.speed / (stiffness * arm)
    damping = _damping(g.law, stiffness, arm) * (closing_rate - dq)
    motor_torque = _motor_torque(g.law, arm * g.grip_force, closing_rate)
    torque: float = motor_torque + damping + _friction(g.law, closing_rate)
    g.torque[finger] = torque
    return torque


@inner_kernel
def _mean_stiffness(grasp: GraspState) -> float:
    return max(mean(grasp.stiffness), _STIFFNESS_MIN)


@inner_kernel
def _rotation_per_offset(grasp: GraspState) -> float:
    """Return the derivative of the object angle with respect to the antisymmetric joint angle."""
    rotation_per_offset: float = grasp.rolling_ratio[0] + grasp.rolling_ratio[1]
    return max(rotation_per_offset, ROTATION_MIN)


@inner_kernel
def _damping(law: GripLaw, stiffness: float, arm: float) -> float:
    """Return the joint damping [N·m·s/rad] for a tip ``stiffness`` and a moment ``arm``."""
    return law.damping * math.sqrt(stiffness * arm * arm)


@inner_kernel
def _grip_force(g: GripState, target: float, measured: float, limit: float) -> float:
    """Return the sum of ``target`` and the force feedback, but at most ``limit`` [N]."""
    law = g.law
    error = target - measured
    integral = g.integral + law.force_bandwidth * error * law.dt
    g.integral = clip(integral, max(limit - g.force.target, 0.0))
    force: float = target + (law.force_gain * error + g.integral)
    return min(force, limit)


@inner_kernel
def _force_limit(g: GripState, arm: float, free_torque: float, load: float) -> float:
    """Return an upper limit for the grip force [N].

    The limit does not depend on the measured force. It is the target force plus three margins. The
    margins cover the torque constant error, the joint friction and the torque ``load`` [N·m] that
    the detected load causes. ``arm`` is the moment arm of the grip force [m], and ``free_torque``
    is the maximum joint torque during the approach [N·m].
    """
    force: float = g.force.target * (1.0 + _TORQUE_ERROR_SIGMA * g.law.torque_error)
    friction = slip_monitor.coulomb_friction(g.slip, free_torque)
    return force + (friction + load) / max(arm, g.slip.law.arm_min)


@inner_kernel
def _steer(g: GripState, windows: FloatArray, grasp: GraspState, angle: float) -> float:
    """Move the goal of the antisymmetric joint angle; return its feed-forward rate [rad/s]."""
    target = setpoint.advance(g.angle, windows, g.law.rotate_speed)
    rotation = _rotation_per_offset(grasp)
    offset_rate = g.angle.speed / rotation
    if not math.isnan(angle):
        error = target - angle
        # The dead band prevents stationary joints from following noise.
        if setpoint.has_arrived(g.angle):
            noise = GATE * grasp.angle_std
            error -= clip(error, noise)
        g.offset += g.law.rotate_bandwidth * error / rotation * g.law.dt
    g.offset += offset_rate * g.law.dt
    return offset_rate


@inner_kernel
def _distribute(g: GripState, grasp: GraspState) -> None:
    """Equalise the tip forces if friction between the object and its support unbalances them.

    The force controller acts only on the mean tip force. To equalise the forces, both fingers
    rotate by a small angle in the same direction. The object then rotates by at most half of
    ANGLE_TOLERANCE.
    """
    off = (
        0.5
        * (grasp.normal[0] - grasp.normal[1])
        / (_mean_stiffness(grasp) * mean(grasp.moment_arm))
    )
    limit = 0.5 * ANGLE_TOLERANCE / _rotation_per_offset(grasp)
    balance_offset = clip(
        g.balance_offset - 2.0 * math.pi * _DISTRIBUTE_BANDWIDTH * off * g.law.dt, limit
    )
    g.offset += balance_offset - g.balance_offset
    g.balance_offset = balance_offset


@inner_kernel
def _closing_rate(g: GripState, grasp: GraspState, rate: float) -> float:
    """Return the closing rate [rad/s] that changes the force at ``rate`` [N/s].

    The closing rate also compensates for a rotation of the object.
    """
    arm = grasp.moment_arm
    rotation = grasp.rolling_ratio
    d_rate = 2.0 * rate / _mean_stiffness(grasp)
    d_rate -= (arm[0] - arm[1] + grasp.slide * (rotation[0] + rotation[1])) * g.offset_rate
    closing: float = d_rate / (arm[0] + arm[1])
    return closing


@inner_kernel
def _torques(
    g: GripState, grasp: GraspState, closing_rate: float, dq: tuple[float, float]
) -> tuple[float, float]:
    """Return both joint torques for the commanded closing and offset rates [rad/s]."""
    law = g.law
    arm = mean(grasp.moment_arm)
    damping = _damping(law, _mean_stiffness(grasp), arm)
    damping *= closing_rate - 0.5 * (dq[0] + dq[1])
    error = g.offset - 0.5 * (grasp.q[0] - grasp.q[1])
    steering = g.joint_stiffness * error
    steering += law.damping * math.sqrt(g.joint_stiffness) * (g.offset_rate - 0.5 * (dq[0] - dq[1]))
    arms = grasp.moment_arm if law.is_blind else grasp.energy_arm
    for k in range(2):
        sense = 1.0 - 2.0 * k
        rate = closing_rate + sense * g.offset_rate
        motor_torque = _motor_torque(law, arms[k] * g.grip_force, rate)
        g.torque[k] = motor_torque + damping + sense * steering + _friction(law, rate)
    return g.torque[0], g.torque[1]


@inner_kernel
def _equal_torques(
    g: GripState, grasp: GraspState, target: float, closing_rate: float, dq: tuple[float, float]
) -> tuple[float, float]:
    """Return joint torques at which both tips push with equal force at any object angle.

    After the dither, the joints hold the antisymmetric angle (q1 − q2)/2.
    """
    law, q = g.law, grasp.q
    closed = mean(q)
    arm = law.length * math.cos(closed) - law.offset * math.sin(closed)
    damping = _damping(law, _mean_stiffness(grasp), arm)
    damped = damping * (closing_rate - 0.5 * (dq[0] + dq[1]))
    common = (
        _motor_torque(law, arm * g.grip_force, closing_rate) + damped + _friction(law, closing_rate)
    )
    if g.dither_elapsed < law.dither_time:
        steering = _dither(g, grasp, target)
    else:
        steering = g.joint_stiffness * (g.offset - 0.5 * (q[0] - q[1]))
        steering -= 0.5 * damping * (dq[0] - dq[1])
    g.last_time = grasp.t
    g.torque[0] = common + steering
    g.torque[1] = common - steering
    return g.torque[0], g.torque[1]


@inner_kernel
def _dither(g: GripState, grasp: GraspState, target: float) -> float:
    """Advance the dither; return its antisymmetric torque [N·m].

    The virtual spring from `hand.upright` acts between the fingers. An oscillating torque overcomes
    the joint friction. The oscillating torque decays slowly, so that friction does not leave a bias
    in the joint angles.
    """
    law, q = g.law, grasp.q
    antisymmetric = 0.5 * (q[0] - q[1])
    lengths = Lengths(law.half_separation, law.length, law.offset, law.radius)
    spring = upright_spring(mean(q), mean(grasp.d), target, grasp.tilt_moment_ratio, lengths)
    spring = min(spring, g.joint_stiffness)
    # Set `offset` so that the torque does not jump when the dither ends and the hold begins.
    g.offset = antisymmetric * (1.0 - spring / g.joint_stiffness)
    # The amplitude rises during the first period and decays to zero by the end of the dither.
    phase = law.dither_rate * g.dither_elapsed
    amplitude = min(phase / (2.0 * math.pi), 1.0) * (1.0 - g.dither_elapsed / law.dither_time)
    if g.dither_elapsed > 0.0 or setpoint.has_arrived(g.force):
        # Measure the time with the clock. If ticks are late, counting ticks would slow the dither.
        # A slow dither could excite the resonance of the fingers on the soft tips at 1 to 2 Hz.
        # Even a very late tick advances the dither by at most a quarter of its period.
        quarter_period = 0.5 * math.pi / law.dither_rate
        g.dither_elapsed += min(max(grasp.t - g.last_time, 0.0), quarter_period)
    torque: float = amplitude * law.dither_torque * math.sin(phase) - spring * antisymmetric
    return torque


@inner_kernel
def _motor_torque(law: GripLaw, torque: float, rate: float) -> float:
    """Return the motor torque [N·m] required for a tip ``torque`` at a joint ``rate`` [rad/s].

    A rate of 0 counts as closing.
    """
    opening = min(max(-rate / law.friction_speed, 0.0), 1.0)
    return torque * (law.driving - opening * (law.driving - 1.0 / law.driving))


@inner_kernel
def _friction(law: GripLaw, rate: float) -> float:
    """Return the joint friction torque [N·m] at the commanded ``rate`` [rad/s]."""
    return law.joint_friction * clip(rate / law.friction_speed, 1.0)
