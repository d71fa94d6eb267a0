"""The grip laws' state and kernels; `control.grip` explains the laws.

Kernels that Python calls take the laws' state, the grasp of this tick, and the windows of both
setpoints. Pairs are (left, right). SI units.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.control import setpoint, slip_monitor
from softfinger.daemon.control.setpoint import SetpointState
from softfinger.daemon.control.slip_monitor import SlipState, mean
from softfinger.daemon.perception.grasp import GraspState
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records
from softfinger.kinematics.hand.upright import upright_spring

FloatArray = NDArray[np.float64]

_SURE = 2.0  # standard deviations of the torque constants that a grip may need
_ARM_MIN = 0.1  # of the finger's length
_INTEGRAL_RATIO = 0.3  # the integral's bound, as a share of the force wanted
_DISTRIBUTE_BANDWIDTH = 2.0  # Hz of the integral of the tips' difference
_DISTRIBUTE_ANGLE = 3e-3  # rad that the object may turn by that
_QUIET = 3.0  # standard deviations of the angle that the joints at rest don't follow
_LONGEST_PAUSE = 0.05  # s of the dither's time that passes at once after ticks without
_STIFFNESS_MIN = 100.0  # N/m, below which a contact is too light to scale by
_ROTATION_MIN = 0.1  # of the object over the antisymmetric angle, likewise


class GripLaw(Record):
    """Constants of the grip laws."""

    dt: float  # [s]
    force_gain: float
    force_bandwidth: float  # [rad/s]
    rotate_bandwidth: float  # [rad/s]
    rotate_speed: float  # [rad/s]
    damping: float  # 2 ζ √J, times √stiffness the damping [N·m·s/rad]
    friction: float  # of a joint [N·m]
    driving: float  # motor's torque over the tip's of a joint that closes
    friction_speed: float  # from which on all of it is given [rad/s]
    torque_max: float  # [N·m]
    torque_error: float  # relative, of the joints' torque constants
    decay: float  # what is left of a turning a tick later without frames
    upright: bool  # the fingers' shaking brings the object upright, its angle is not looked at
    half_separation: float  # of the hand, in m as its other lengths
    length: float
    offset: float
    radius: float
    dither_torque: float  # [N·m]
    dither_rate: float  # [rad/s]
    dither_time: float  # in which it fades [s]


class GripState(Record):
    """Commanded values and memory of the grip laws."""

    law: GripLaw
    force: SetpointState  # mean of the tips [N]
    angle: SetpointState  # of the object [rad]
    slip: SlipState
    commanded: float  # force [N]
    force_rate: float  # [N/s]
    joint_stiffness: float  # [N·m/rad]
    steering: bool  # the object's angle has a target
    integral: float  # [N]
    grip_force: float  # that the joints give, both laws' parts together [N]
    offset_rate: float  # speed of the offset that turns the object [rad/s]
    offset: float  # goal of (q1 − q2)/2 [rad]
    dither_elapsed: float  # since the dither began [s]
    seen: float  # when the joints were last read while both pushed alike [s]
    shift: float  # of the offset, to share the force out between the tips [rad]
    closing_friction: float  # share of the joints' friction that is given for closing
    torque: Pair  # last of both joints [N·m]


@kernel
def start(
    grips: Records[GripState],
    grasps: Records[GraspState],
    force_windows: FloatArray,
    felt: float,
) -> None:
    """Take over from the approach with ``felt`` N on the tips."""
    g = grips[0]
    q = grasps[0].q
    slip_monitor.reset(g.slip)
    setpoint.reset(g.force, force_windows, felt)
    g.integral = g.shift = g.closing_friction = g.dither_elapsed = 0.0
    g.offset = 0.5 * (q[0] - q[1])
    g.steering = False
    g.seen = grasps[0].t


@kernel
def begin_holding(grips: Records[GripState], grasps: Records[GraspState]) -> None:
    """Mark the grip as settled: from now on loads show."""
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
) -> tuple[float, float, float, bool]:
    """Return torques of both joints [N·m], the target force [N], and whether the object slipped.

    ``angle`` is the object's angle [rad], NaN where it is not known. ``dq``: joint velocities
    [rad/s]. ``holding``: nothing but loads moves the joints.
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
    if g.slip.reflex and g.force.target > g.force.value:
        setpoint.reset(g.force, force_windows, g.force.target)
    target = setpoint.advance(g.force, force_windows, g.force_rate)
    bound = _INTEGRAL_RATIO * g.force.target
    grip_force = target + _correction(g, target, mean(grasp.force), bound)
    load = grasp.load_arm * g.slip.load
    g.grip_force = min(grip_force, _force_limit(g, load, mean(grasp.moment_arm)))
    if g.law.upright and not g.steering:
        torque1, torque2 = _equal_torques(g, grasp, target, dq)
        return torque1, torque2, g.force.target, g.slip.turned
    offset_rate = 0.0
    if g.steering:
        offset_rate = _steer(g, angle_windows, grasp, angle)
    g.offset_rate = offset_rate
    if setpoint.arrived(g.force) and not (g.steering and not setpoint.arrived(g.angle)):
        _distribute(g, grasp)
    close = _closing(grasp, g.force.speed, offset_rate)
    g.closing_friction = min(max(close / g.law.friction_speed, -1.0), 1.0)
    torque1, torque2 = _torques(g, grasp, close, offset_rate, dq)
    return torque1, torque2, g.force.target, g.slip.turned


@kernel
def hold_goal(
    grips: Records[GripState], grasps: Records[GraspState], dq: tuple[float, float]
) -> tuple[float, float]:
    """Replace :func:`grip_torques` while frames are late: the force stays, turning ends."""
    g = grips[0]
    g.offset_rate *= g.law.decay
    g.offset += g.offset_rate * g.law.dt
    return _torques(g, grasps[0], _closing(grasps[0], 0.0, g.offset_rate), g.offset_rate, dq)


@kernel
def single_torque(
    grips: Records[GripState],
    grasps: Records[GraspState],
    force_windows: FloatArray,
    finger: int,
    dq: float,
    frames_late: bool,
) -> float:
    """Return torque [N·m] of one ``finger`` on an object that stands by itself.

    ``frames_late``: the force stays.
    """
    g = grips[0]
    grasp = grasps[0]
    arm = grasp.moment_arm[finger]
    stiffness = max(grasp.stiffness[finger], _STIFFNESS_MIN)
    close = 0.0
    if not frames_late:
        target = setpoint.advance(g.force, force_windows, g.force_rate)
        # The object stands by itself, so that the tip's friction on it may take some of the torque.
        q, law = grasp.q[finger], g.law
        reach = law.length * math.sin(q) + law.offset * math.cos(q) + law.radius
        limit = _force_limit(g, g.slip.law.friction * g.force.target * max(reach, 0.0), arm)
        bound = max(limit - g.force.target, 0.0)
        g.grip_force = min(target + _correction(g, target, grasp.force[finger], bound), limit)
        close = g.force.speed / (stiffness * arm)
    damping = g.law.damping * math.sqrt(stiffness * arm * arm) * (close - dq)
    geared = _geared(g.law, arm * g.grip_force, close)
    torque: float = geared + damping + _friction(g.law, close)
    g.torque[finger] = torque
    return torque


@inner_kernel
def _mean_stiffness(grasp: GraspState) -> float:
    return max(mean(grasp.stiffness), _STIFFNESS_MIN)


@inner_kernel
def _turning(grasp: GraspState) -> float:
    """Return ∂φ of the object by the antisymmetric joint angle."""
    both: float = grasp.jacobian_rotation[0] + grasp.jacobian_rotation[1]
    return max(both, _ROTATION_MIN)


@inner_kernel
def _correction(g: GripState, target: float, felt: float, bound: float) -> float:
    """Return the force [N] that feedback adds to the feed-forward; ``bound``: of its integral."""
    law = g.law
    error = target - felt
    # Beyond what the servos may give, more error must not be stored.
    full = abs(g.torque[0]) >= law.torque_max or abs(g.torque[1]) >= law.torque_max
    if not full or error < 0.0:
        integral = g.integral + law.force_bandwidth * error * law.dt
        g.integral = min(max(integral, -bound), bound)
    return law.force_gain * error + g.integral


@inner_kernel
def _force_limit(g: GripState, load: float, arm: float) -> float:
    """Upper limit [N] of the grip force for the target force, independent of the sensors.

    Beside what the torque constants may be off, friction and the torque [N·m] of the ``load`` that
    is believed may take some; ``arm`` [m]: the force's lever.
    """
    law = g.law
    force: float = g.force.target * (1.0 + _SURE * law.torque_error)
    return force + (law.friction + load) / max(arm, _ARM_MIN * law.length)


@inner_kernel
def _steer(g: GripState, windows: FloatArray, grasp: GraspState, angle: float) -> float:
    """Move the antisymmetric goal; returns its rate [rad/s]."""
    target = setpoint.advance(g.angle, windows, g.law.rotate_speed)
    rotation = _turning(grasp)
    offset_rate = g.angle.speed / rotation
    if not math.isnan(angle):
        error = target - angle
        if setpoint.arrived(g.angle):  # what is no more than noise, joints at rest shall not follow
            noise = _QUIET * grasp.angle_std
            error -= min(max(error, -noise), noise)
        g.offset += g.law.rotate_bandwidth * error / rotation * g.law.dt
    g.offset += offset_rate * g.law.dt
    return offset_rate


@inner_kernel
def _distribute(g: GripState, grasp: GraspState) -> None:
    """Balance the tips' forces, which the object's friction on the table keeps apart.

    The force law holds their mean; friction may keep the object where one tip is pressed more.
    Both fingers then shift sideways by a little, less than the object's angle is held to.
    """
    off = (
        0.5
        * (grasp.normal[0] - grasp.normal[1])
        / (_mean_stiffness(grasp) * mean(grasp.moment_arm))
    )
    limit = _DISTRIBUTE_ANGLE / _turning(grasp)
    shift = g.shift - 2.0 * math.pi * _DISTRIBUTE_BANDWIDTH * off * g.law.dt
    shift = min(max(shift, -limit), limit)
    g.offset += shift - g.shift
    g.shift = shift


@inner_kernel
def _closing(grasp: GraspState, rate: float, offset_rate: float) -> float:
    """Closing [rad/s] for a ``rate`` [N/s] of the force, what turning takes counted in."""
    arm = grasp.moment_arm
    rotation = grasp.jacobian_rotation
    d_rate = 2.0 * rate / _mean_stiffness(grasp)
    d_rate -= (arm[0] - arm[1] + grasp.jacobian_slide * (rotation[0] + rotation[1])) * offset_rate
    closing: float = d_rate / (arm[0] + arm[1])
    return closing


@inner_kernel
def _torques(
    g: GripState, grasp: GraspState, close: float, offset_rate: float, dq: tuple[float, float]
) -> tuple[float, float]:
    """Torques of two fingers at commanded rates [rad/s] of closing and of the offset."""
    law = g.law
    arm = mean(grasp.moment_arm)
    damping = law.damping * math.sqrt(_mean_stiffness(grasp) * arm * arm)
    damping *= close - 0.5 * (dq[0] + dq[1])
    error = g.offset - 0.5 * (grasp.q[0] - grasp.q[1])
    steering = g.joint_stiffness * error
    steering += law.damping * math.sqrt(g.joint_stiffness) * (offset_rate - 0.5 * (dq[0] - dq[1]))
    lever = grasp.moment_arm if law.upright else grasp.energy_arm
    for k in range(2):
        sense = 1.0 - 2.0 * k
        rate = close + sense * offset_rate
        geared = _geared(law, lever[k] * g.grip_force, rate)
        g.torque[k] = geared + damping + sense * steering + _friction(law, rate)
    return g.torque[0], g.torque[1]


@inner_kernel
def _equal_torques(
    g: GripState, grasp: GraspState, target: float, dq: tuple[float, float]
) -> tuple[float, float]:
    """Torques of two fingers of the same force, whatever the object's angle.

    With the spring of `hand.upright` between the fingers, and a dither that fades and so leaves the
    joints' friction without a bias. Then the joints keep their antisymmetric angle.
    """
    law, q = g.law, grasp.q
    close = _closing(grasp, g.force.speed, 0.0)
    g.offset_rate = 0.0
    g.closing_friction = min(max(close / law.friction_speed, -1.0), 1.0)
    closed = mean(q)
    arm = law.length * math.cos(closed) - law.offset * math.sin(closed)
    damping = law.damping * math.sqrt(_mean_stiffness(grasp) * arm * arm)
    damped = damping * (close - 0.5 * (dq[0] + dq[1]))
    common = _geared(law, arm * g.grip_force, close) + damped + _friction(law, close)
    antisymmetric = 0.5 * (q[0] - q[1])
    steering = -0.5 * damping * (dq[0] - dq[1])
    if g.dither_elapsed < law.dither_time:
        lengths = (law.half_separation, law.length, law.offset, law.radius)
        depth = mean(grasp.d)
        spring = min(
            upright_spring(closed, depth, target, grasp.tip_turning, lengths), g.joint_stiffness
        )
        # What then holds the fingers begins with the torque that the spring has come to.
        g.offset = antisymmetric * (1.0 - spring / g.joint_stiffness)
        # Within its first period it grows, from then on it fades.
        phase = law.dither_rate * g.dither_elapsed
        size = min(phase / (2.0 * math.pi), 1.0) * (1.0 - g.dither_elapsed / law.dither_time)
        steering = size * law.dither_torque * math.sin(phase) - spring * antisymmetric
        if g.dither_elapsed > 0.0 or setpoint.arrived(g.force):
            # By the clock and not by ticks: where these come late the dither must not become slow,
            # for the fingers on the tips swing by themselves at one to two hertz.
            g.dither_elapsed += min(max(grasp.t - g.seen, 0.0), _LONGEST_PAUSE)
    else:
        steering += g.joint_stiffness * (g.offset - antisymmetric)
    g.seen = grasp.t
    g.torque[0] = common + steering
    g.torque[1] = common - steering
    return g.torque[0], g.torque[1]


@inner_kernel
def _geared(law: GripLaw, torque: float, rate: float) -> float:
    """Return the motor's torque for a tip's [N·m] at the commanded ``rate`` [rad/s] of a joint.

    One that rests is given what it needs to close.
    """
    opening = min(max(-rate / law.friction_speed, 0.0), 1.0)
    return torque * (law.driving - opening * (law.driving - 1.0 / law.driving))


@inner_kernel
def _friction(law: GripLaw, rate: float) -> float:
    """Return a joint's friction [N·m] at the commanded ``rate`` [rad/s]."""
    return law.friction * min(max(rate / law.friction_speed, -1.0), 1.0)
