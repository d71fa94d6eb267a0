"""Estimate the load on a held object and the grip force that the load requires.

On each tick, the monitor computes the quantities below. `SlipLaw`, `SlipState` and `GraspState`
define the symbols.

    r         low-pass filtered torque residual of each joint; r̄ is the mean of both joints
    L         load per tip: r̄ − offset = load_arm L + load_curvature L²               (`load_of`)
    load      min(4 max(|L| − joint_friction/(2 load_arm), 0), |L| + joint_friction/slope,
              tip_friction force_limit), with slope = load_arm + 2 load_curvature L
    assumed   max(load, pull, object_load/2), stored as `assumed_load`; `pull` is the pulling force
              [N] that solid tips measure
    needed    assumed/usable_friction, stored as `needed_force`; usable_friction is tip_friction
              (1 − margin) − `grasp.shear`, but at least _SPARE_MIN tip_friction
    force     min(max(commanded, needed), force_limit)

If friction could hide a load that is too large for the grip, `load` is 0. For solid tips, `load` is
limited to the measured shear.

**Offset.** Gear friction, modulus errors and torque constant errors cause a residual even without a
load. The offset is measured when a hold begins, and again after the force or the angle has changed.
A load detected during the previous hold is not part of the offset. The offset then follows r̄
slowly, with a time constant of up to _SETTLING_TIME. If the commanded torque of stationary joints
changes, friction balances the change. The offset then follows the change with the time constant of
r̄. Joint friction can explain an initial offset of up to ±`joint_friction`; `start_offset` is the
part beyond this range. The offset stays within ±`joint_friction` of `start_offset`. Because rubber
relaxes, the lower end of the range is extended by GATE RELAXATION_ERROR (21 %) of the tip moment.

**Load.** Friction hides loads of up to joint_friction/load_arm, which is 2 N per tip for the
built-in hand. Loads below half of this value are ignored. The estimate of a larger load is
increased by the load that friction may hide. An unconfirmed load increases the grip force by at
most the fraction _UNCONFIRMED_SHARE. A load is confirmed when the object rotates, when both joints
yield simultaneously, or when |L| exceeds 2 joint_friction/load_arm.

**Sudden events** increase the force to its limit immediately, because a sliding tip transmits only
its friction force, so the size of the load is unknown. An event is one of these:

- The torques jump by more than the noise while both joints yield. A pull changes both torques in
  the same direction. A twist or a sideways push changes them in opposite directions.
- The shear that solid tips measure jumps.
- The object rotates by more than μ (d1 + d2)/2W. Up to this angle, the tips can shear without
  slipping.

A force increase is held for _SETTLING_TIME. The increase then decays at the rate
increase_max/_DECAY_TIME.

While the force changes or the object rotates, the motors also move the joints, so the load estimate
is not updated. `docs/safety.md` lists the loads that cannot be detected.
"""

from __future__ import annotations

import math

from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.hand_state import AGREEMENT, GATE, OUTLIER_GATE
from softfinger.daemon.perception.prior import RELAXATION_ERROR
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, VELOCITY_UNIT
from softfinger.daemon.types import GRIP_FRACTION
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.hand.grasp_state import FloatPair, load_of

_AVERAGE_TIME = 0.1  # averaging time [s]; velocity readings fluctuate by one count (0.024 rad/s)
_SETTLING_TIME = 1.0  # settling time of the residual, and hold time of a force increase [s]
_DECAY_TIME = 2.0  # time to reduce the force by `grip_raise_max`, and decay time of rotations [s]
_SUDDEN_SHARE = 0.7  # minimum sudden load, as a fraction of the usable friction force
_SHEAR_JUMP = 0.6  # smallest significant shear jump at solid tips [N]; equals 6 σ of the noise
_UNCONFIRMED_SHARE = 0.3  # maximum force increase without confirmation, as a fraction of the force
ARM_MIN = 0.1  # minimum moment arm, as a fraction of the finger length
_SPARE_MIN = 0.3  # minimum usable fraction of the friction coefficient


class SlipLaw(Record):
    """Constants of a slip monitor."""

    dt: float  # [s]
    width: float  # object width [m]
    arm_min: float  # minimum moment arm [m]
    yield_speed: float  # minimum speed change of a joint that yields to a load [rad/s]
    standstill: float  # maximum deviation of a stationary joint from its average angle [rad]
    force_max: float  # [N]
    tip_friction: float  # Coulomb friction coefficient between tip and object
    margin: float  # fraction of the friction coefficient that is reserved as a margin
    joint_friction: float  # `control.joint_friction` [N·m]
    friction_max: float  # maximum joint torque during an approach [N·m]
    load_held: float  # fraction of the tip moment that gear friction can balance
    object_load: float  # [N]
    has_shear: bool  # True if the frames measure shear
    increase_max: float  # [N]
    increase_ratio: float  # maximum force increase as a fraction of the commanded force


class SlipState(Record):
    """Estimated load, friction and force increase for one held object."""

    law: SlipLaw
    joint_friction: float  # joint friction, including the force-dependent part [N·m]
    residual: Pair  # average joint torque residuals [N·m]
    variance: Pair  # variances of the mean residual and of half the residual difference [N²·m²]
    speed: Pair  # average joint speeds [rad/s]
    q: Pair  # joint angles, averaged over _SETTLING_TIME [rad]
    torque: float  # mean torque of both joints on the previous tick [N·m]
    is_watched: bool  # True if a load at the start of the hold would have changed the torques
    offset: float  # residual without a load [N·m]
    balanced_torque: float  # torque that friction balances, not yet part of `offset` [N·m]
    start_offset: float  # part of the initial offset that friction can't explain [N·m]
    deviation: float  # part of the residual that is attributed to a load [N·m]
    moment: float  # moment of the tip forces at the start of the hold [N·m]
    holding_time: float  # time since the start of the hold, at most _SETTLING_TIME [s]
    load: float  # load per tip, including the part hidden by friction [N]
    assumed_load: float  # largest of `load`, the measured shear and half the declared load [N]
    is_confirmed: bool  # True if a load may increase the force by more than _UNCONFIRMED_SHARE
    pull: float  # average pulling force measured by solid tips [N]
    twist: float  # average twisting force measured by solid tips [N]
    usable_friction: float  # friction coefficient, reduced by the slip margin and by rolling
    rotation_seen: Pair  # value of `unexplained_rotation` at the previous update [rad]
    rotation: Pair  # unexplained rotation per tip during the last _DECAY_TIME [rad]
    has_turned: bool  # True if a rotation of the object in the grip was detected on this tick
    reflex_triggered: bool  # True if a sudden load or a rotation was detected on this tick
    needed_force: float  # required force [N], held for _SETTLING_TIME
    force_limit: float  # [N]
    balanced_max: float  # mean tip force at which the more heavily loaded tip reaches its limit [N]
    idle_time: float  # time since the last request for a force increase [s]


def configure(s: SlipState, settings: Settings) -> None:
    """Set the constants from the settings."""
    law, control = s.law, settings.control
    law.dt = 1.0 / settings.loop.rate
    law.width = settings.object.width
    law.arm_min = ARM_MIN * settings.hand.finger_length
    law.yield_speed = 0.5 * VELOCITY_UNIT / settings.servos.gear_ratio
    law.standstill = 2.0 * math.pi / (COUNTS_PER_TURN * settings.servos.gear_ratio)
    law.force_max = GRIP_FRACTION * settings.safety.force_max
    law.tip_friction, law.margin = control.tip_friction, control.slip_margin
    law.joint_friction = control.joint_friction
    law.friction_max = control.approach_current * control.torque_constant
    law.load_held = control.load_held
    law.object_load = control.object_load
    law.has_shear = settings.tip.physics == "solid"
    law.increase_max, law.increase_ratio = control.grip_raise_max, control.grip_raise_share
    s.usable_friction = max(1.0 - law.margin, _SPARE_MIN) * law.tip_friction


@inner_kernel
def reset(s: SlipState) -> None:
    """Reset the load, the friction and the force increase.

    Call this kernel when the object is released or replaced.
    """
    s.is_watched = s.is_confirmed = s.has_turned = s.reflex_triggered = False
    s.joint_friction = s.offset = s.start_offset = s.deviation = s.moment = s.holding_time = 0.0
    s.balanced_torque = 0.0
    s.load = s.assumed_load = s.pull = s.twist = 0.0
    s.residual[:] = s.variance[:] = s.speed[:] = s.q[:] = 0.0
    s.rotation_seen[:] = s.rotation[:] = 0.0
    s.needed_force = s.force_limit = s.balanced_max = s.idle_time = 0.0


@inner_kernel
def begin(s: SlipState, grasp: GraspState) -> None:
    """Begin a hold, or continue a hold after the force or the angle has changed.

    If the previous hold ended without a load, the offset is set to the present residual. Otherwise,
    the load is assumed to persist, but the offset stays within the permitted range. The range
    scales with the force.
    """
    s.is_watched = grasp.load_arm > 0.0
    if not s.is_watched:
        return
    moment = _moment(grasp)
    if s.load > 0.0 and s.moment > 0.0:
        s.start_offset *= moment / s.moment
        off = mean(s.residual) - s.deviation - s.start_offset
        s.offset = s.start_offset + clip(off, s.joint_friction)
    else:
        s.offset = mean(s.residual)
        s.start_offset = s.offset - clip(s.offset, s.joint_friction)
    s.moment = moment
    s.rotation[:] = 0.0
    s.balanced_torque = 0.0
    s.q[0], s.q[1] = grasp.q[0], grasp.q[1]
    s.holding_time = _AVERAGE_TIME


@inner_kernel
def mean(pair: Pair) -> float:
    """Return the mean of (left, right)."""
    value: float = 0.5 * (pair[0] + pair[1])
    return value


@inner_kernel
def _moment(grasp: GraspState) -> float:
    """Return the mean moment of the normal forces about the joints [N·m]."""
    return mean(grasp.normal) * mean(grasp.moment_arm)


@inner_kernel
def clip(value: float, bound: float) -> float:
    """Clip ``value`` to ±``bound``."""
    return min(max(value, -bound), bound)


@inner_kernel
def update(
    s: SlipState,
    grasp: GraspState,
    commanded: float,
    holding: bool,
    closing: float,
    dq: FloatPair,
    torques: Pair,
) -> float:
    """Return the ``commanded`` grip force [N], increased if the load requires a higher force.

    ``holding`` is True while only loads move the joints. ``closing`` (−1 to 1) is the fraction of
    the joint friction that the torques include. ``dq`` contains the joint velocities [rad/s].
    ``torques`` contains the joint torques of the previous tick [N·m].
    """
    law = s.law
    spare_friction = _update_friction(s, grasp)
    sudden_min = _SUDDEN_SHARE * max(spare_friction, 0.0) * mean(grasp.normal)
    is_held = holding and s.is_watched and grasp.load_arm > 0.0
    sudden = _detect_torque_jump(s, grasp, closing, dq, is_held, sudden_min)
    pull = max(abs(grasp.pull_shear) - grasp.shear * mean(grasp.normal), 0.0)
    sudden = _detect_shear_jump(s, pull, grasp.twist_shear, is_held, sudden_min) or sudden
    s.has_turned = False
    if is_held:
        _estimate_load(s, grasp, mean(torques) - s.torque)
        s.has_turned = _has_turned(s, grasp)
    s.rotation_seen[0] = grasp.unexplained_rotation[0]
    s.rotation_seen[1] = grasp.unexplained_rotation[1]
    s.torque = mean(torques)
    # Ignore the torques if joint friction could hide a load that is too large for the grip.
    if law.tip_friction * commanded * grasp.load_arm <= s.joint_friction:
        s.load = 0.0
    if law.has_shear:  # Any load beyond the measured shear is due to a force error.
        s.load = min(s.load, pull + _SHEAR_JUMP)
    if grasp.sensor_fault:
        s.load = pull = s.needed_force = 0.0
        s.has_turned = sudden = s.is_confirmed = False
    s.assumed_load = max(s.load, pull, 0.5 * law.object_load)
    return _increased_force(s, grasp, commanded, sudden)


@inner_kernel
def _update_friction(s: SlipState, grasp: GraspState) -> float:
    """Set the joint friction and the usable tip friction; return the unclipped tip friction.

    Rolling uses a part of the tip friction that increases with the grip force.
    """
    law = s.law
    s.joint_friction = coulomb_friction(s, mean(grasp.free_torque))
    s.joint_friction += law.load_held * _moment(grasp)
    spare_friction = law.tip_friction * (1.0 - law.margin) - grasp.shear
    s.usable_friction = max(spare_friction, _SPARE_MIN * law.tip_friction)
    return spare_friction


@inner_kernel
def coulomb_friction(s: SlipState, free_torque: float) -> float:
    """Return the load-independent joint friction [N·m].

    The setting is used unless the joint required a higher ``free_torque`` during the approach.
    """
    friction: float = min(max(free_torque, s.law.joint_friction), s.law.friction_max)
    return friction


@inner_kernel
def _increased_force(s: SlipState, grasp: GraspState, commanded: float, sudden: bool) -> float:
    """Return the grip force [N] that the assumed load and the events of this tick require."""
    s.reflex_triggered = s.has_turned or sudden
    s.is_confirmed = s.is_confirmed or s.reflex_triggered
    imbalance = 0.5 * abs(grasp.force[0] - grasp.force[1])
    s.balanced_max = max(s.law.force_max - imbalance, commanded)
    s.force_limit = _force_limit(s, commanded, 0.5 * s.law.object_load / s.usable_friction)
    needed_force = s.assumed_load / s.usable_friction
    if s.reflex_triggered:
        needed_force = s.force_limit
    _update_needed_force(s, needed_force, commanded)
    return min(max(commanded, s.needed_force), s.force_limit)


@inner_kernel
def _update_needed_force(s: SlipState, needed_force: float, commanded: float) -> None:
    """Hold a force increase for _SETTLING_TIME, then let it decay."""
    if needed_force >= s.needed_force:
        s.needed_force = min(needed_force, s.force_limit)
        s.idle_time = 0.0
        return
    s.idle_time += s.law.dt
    if s.idle_time > _SETTLING_TIME:
        decrease = s.law.increase_max / _DECAY_TIME * s.law.dt
        s.needed_force = max(s.needed_force - decrease, needed_force)
        s.is_confirmed = s.is_confirmed and s.needed_force > commanded


@inner_kernel
def _force_limit(s: SlipState, commanded: float, declared: float) -> float:
    """Return the upper limit [N] of an increased grip force.

    ``declared`` [N] is the force that the declared load requires. An increase up to ``declared``
    needs no confirmation.
    """
    law = s.law
    share = law.increase_ratio if s.is_confirmed else min(law.increase_ratio, _UNCONFIRMED_SHARE)
    increase = min(max(share * commanded, declared - commanded), law.increase_ratio * commanded)
    return min(commanded + min(increase, law.increase_max), s.balanced_max)


@inner_kernel
def _detect_torque_jump(
    s: SlipState, grasp: GraspState, closing: float, dq: FloatPair, is_held: bool, sudden_min: float
) -> bool:
    """Average the residuals; return True if they show a sudden pull or twist."""
    known_torque = closing * s.law.joint_friction
    change1 = grasp.torque_residual[0] - known_torque - s.residual[0]
    change2 = grasp.torque_residual[1] - known_torque - s.residual[1]
    sudden = is_held and (
        _has_jumped(s, grasp, 0, (change1, change2), dq, sudden_min)
        or _has_jumped(s, grasp, 1, (change1, change2), dq, sudden_min)
    )
    weight = 1.0 if sudden else s.law.dt / _AVERAGE_TIME
    if not sudden:
        for k in range(2):
            change = 0.5 * (change1 + (1.0 - 2.0 * k) * change2)
            s.variance[k] += (change * change - s.variance[k]) * s.law.dt / _SETTLING_TIME
    s.residual[0] += change1 * weight
    s.residual[1] += change2 * weight
    for k in range(2):
        s.speed[k] += (dq[k] - s.speed[k]) * s.law.dt / _AVERAGE_TIME
    return sudden


@inner_kernel
def _has_jumped(
    s: SlipState,
    grasp: GraspState,
    kind: int,
    changes: FloatPair,
    dq: FloatPair,
    sudden_min: float,
) -> bool:
    """Return True if the residual ``changes`` [N·m] show a pull (kind 0) or a twist (kind 1).

    A pull changes both residuals equally, whereas a twist changes them in opposite directions. Four
    tests exclude other causes:

    1. Both residuals change. A wrong current reading or a wrong frame affects only one joint.
    2. The change exceeds the noise.
    3. Both joints yield to the load.
    4. The load increases to a large fraction of the friction force. For this test, half of the load
       that joint friction may hide is added to the measured load.
    """
    sense = 1.0 - 2.0 * kind
    change = 0.5 * (changes[0] + sense * changes[1])
    smaller = min(changes[0] * change, sense * changes[1] * change)
    noise = GATE * math.sqrt(s.variance[kind])
    if smaller <= AGREEMENT * change * change or abs(change) <= noise:
        return False
    sign = math.copysign(1.0, change)
    yield1 = sign * (s.speed[0] - dq[0])
    yield2 = sense * sign * (s.speed[1] - dq[1])
    last = 0.5 * (s.residual[0] + sense * s.residual[1])
    now = last + change
    if kind == 0:
        last, now = _load_torque(s, last), _load_torque(s, now)
    else:
        friction = clip(last, s.joint_friction)
        last, now = last - friction, now - friction
    if min(yield1, yield2) <= s.law.yield_speed or abs(now) <= abs(last):
        return False
    curvature = grasp.load_curvature if kind == 0 else 0.0
    load, slope = load_of(now, grasp.load_arm, curvature)
    hidden = s.joint_friction / max(slope, s.law.arm_min)
    has_jumped: bool = abs(load) + 0.5 * hidden > sudden_min
    return has_jumped


@inner_kernel
def _detect_shear_jump(
    s: SlipState, pull: float, twist: float, is_held: bool, sudden_min: float
) -> bool:
    """Average the shear loads [N] that solid tips measure; return True if a load jumped."""
    pull_jump = pull - s.pull
    twist_jump = twist - s.twist
    s.pull += pull_jump * s.law.dt / _AVERAGE_TIME
    s.twist += twist_jump * s.law.dt / _AVERAGE_TIME
    pulled = pull_jump > _SHEAR_JUMP and pull > sudden_min
    twisted = abs(twist_jump) > _SHEAR_JUMP and abs(twist) > sudden_min
    return is_held and (pulled or twisted)


@inner_kernel
def _estimate_load(s: SlipState, grasp: GraspState, torque_change: float) -> None:
    """Estimate the load from the part of the residual that friction cannot explain.

    ``torque_change`` is the change in mean joint torque since the previous tick [N·m].
    """
    law = s.law
    smaller = 0.0
    if s.residual[0] * s.residual[1] > 0.0:
        smaller = min(abs(s.residual[0]), abs(s.residual[1]))
    residual = clip(
        mean(s.residual), 2.0 * smaller + s.joint_friction
    )  # A load acts on both joints.
    s.holding_time = min(s.holding_time + law.dt, _SETTLING_TIME)
    _update_offset(s, grasp, residual, torque_change)
    s.deviation = _load_torque(s, residual)
    load, slope = load_of(s.deviation, grasp.load_arm, grasp.load_curvature)
    load = abs(load)
    hidden = s.joint_friction / grasp.load_arm
    s.is_confirmed = s.is_confirmed or load > 2.0 * hidden
    # Joint friction can hide loads of up to `hidden`. The estimate is 0 up to |L| = `hidden`/2. The
    # estimate then rises to |L| + `hidden` at |L| = `hidden`.
    ignored = 0.5 * hidden
    hidden = s.joint_friction / max(slope, law.arm_min)
    s.load = min(max(4.0 * (load - ignored), 0.0), load + hidden, law.tip_friction * s.force_limit)


@inner_kernel
def _load_torque(s: SlipState, residual: float) -> float:
    """Return the part of a mean ``residual`` [N·m] that a load explains.

    If the residual changes because friction decreases or reverses, or because a load ends that the
    offset has followed, the change is not a load.
    """
    increase = residual - s.start_offset
    return min(max(residual - s.offset, min(increase, 0.0)), max(increase, 0.0))


@inner_kernel
def _update_offset(s: SlipState, grasp: GraspState, residual: float, torque_change: float) -> None:
    """Let the offset follow the ``residual`` [N·m] within the range that friction can explain."""
    law = s.law
    is_standing = True
    for k in range(2):
        s.q[k] += (grasp.q[k] - s.q[k]) * law.dt / _SETTLING_TIME
        is_standing = is_standing and abs(grasp.q[k] - s.q[k]) < law.standstill
    if is_standing:
        s.balanced_torque += torque_change
    step = s.balanced_torque * law.dt / _AVERAGE_TIME  # The residual is averaged in the same way.
    s.balanced_torque -= step
    s.offset += step
    relaxation = GATE * RELAXATION_ERROR * _moment(grasp)
    deviation = residual - s.offset
    if -s.joint_friction - relaxation < deviation < s.joint_friction:
        s.offset += deviation * law.dt / s.holding_time
    lowest = s.start_offset - s.joint_friction - relaxation
    s.offset = min(max(s.offset, lowest), s.start_offset + s.joint_friction)


@inner_kernel
def _has_turned(s: SlipState, grasp: GraspState) -> bool:
    """Return True if the object has rotated further than the shear of the tips allows.

    Both tips must show the rotation, because one faulty sensor can report a false rotation.
    """
    for k in range(2):
        s.rotation[k] += grasp.unexplained_rotation[k] - s.rotation_seen[k]
        s.rotation[k] -= s.rotation[k] * s.law.dt / _DECAY_TIME
    total = s.rotation[0] + s.rotation[1]
    agrees = min(s.rotation[0] * total, s.rotation[1] * total) > AGREEMENT * total * total
    by_shear = 0.5 * s.law.tip_friction * (grasp.d[0] + grasp.d[1]) / s.law.width
    noise = OUTLIER_GATE * grasp.angle_std
    turned: bool = agrees and abs(total) > by_shear + noise
    if turned:
        s.rotation[:] = 0.0
    return turned
