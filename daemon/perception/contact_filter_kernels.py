"""State and kernels of the contact filter: a Kalman filter with delayed, gated measurements.

Prediction by the joints, at each tick, with a, r, s the rows ``moment_arm``, ``jacobian_rotation``
and ``jacobian_slide`` of the grasp Jacobian (`hand.grasp_state.held_motion`):

    Δφ = r1 Δq1 − r2 Δq2        Δd1 = Δd2 = (a1 Δq1 + a2 Δq2 + s Δφ)/2
    variance += drift² dt       displacement += Δ       path_length += |Δ|

A prediction's variance is P = variance + (0.05 path_length)² + min(path_length², step²/12), `step`
being what a count of the encoder moves it by. Update by a frame that was sampled at t, with d_since
and angle_since the displacements from t on, out of the history, and R the frame's covariance less
its systematic part (upper signs: left tip; cells that respond slowly show displacements s(t) with
ds/dt = (displacement − s)/response, so the history keeps these):

    innovation = d_frame − (d − d_since)                         state (d, gain), H = 1
    innovation = (θ ∓ q) − (φ ∓ α/2 − angle_since)               state (φ, α), H = (1, ∓1/2)
    K = P Hᵀ (H P Hᵀ + R)⁻¹       state += K innovation       P = (1 − K H) P

A frame that was fitted with a fixed gain, as of a solid tip, shows d A^(1/n), where F ∝ dⁿ and A is
the gain; ln d and ln A are the state then, H = (1, 1/n), and A stays what it is but for the sensor:

    closing     innovation = ln d_frame − ln (d − d_since) − ln A/n
    turning     the same for d alone: rolling is no closing
    holding     the same for d alone, within a count of the joints; A takes what is beyond

A tip of rubber relaxes: with r_i, τ_i of ``tip.relaxation`` its firmness is
ρ = 1 + Σ r_i (1 − h_i/F), ḣ_i = (F − h_i)/τ_i, where F is the force that lasts; frames show A ρ.

The gate: beyond innovation² = _GATE · (H P Hᵀ + R) the prediction was wrong, not the frame, and
innovation² is put into P first. A frame of an angle beyond `witnesses.JUMP` is refused instead. The
force is ρ e^ε F_table(d, θ), its variance (∂F/∂d σ_d)² + (∂F/∂θ σ_θ)² + (σ_ε² + law²) F², with
the modulus' logarithm ε of `perception.scales`. Pairs are (left, right). SI units.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception import scales, witnesses
from softfinger.daemon.perception.scales import Scales
from softfinger.daemon.perception.witnesses import WitnessState
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
Noise = tuple[float, float, float]  # of a frame: variance of d, covariance, variance of the gain

OTHER, RAMPING, HOLDING = 0, 1, 2  # phases of a grip: its force is on its way, nothing moves it
HISTORY = 0.5  # s of joint motion stored: an older frame is taken as so old
_DRIFT_D = 1e-4  # m/√s, what d does by itself: the object shifts, the tip creeps
_DRIFT_GAIN = 0.1  # 1/√s, what the frames' height over the model's does
_D_MIN = 1e-5  # m that touches
_LIMP = 0.02  # least firmness, of a tip that comes back late
_DRIFT_ANGLE = 4e-3  # rad/√s, likewise
_DRIFT_TAPER = 1e-3  # rad/√s, what the taper does: tips come to other parts of the faces
_TAPER_ERROR = 0.1  # rad that `object.taper` may be off
_MOTION_ERROR = 0.05  # of a predicted motion, relative
_TURN_MOST = 1.0  # rad from reading to reading
_GATE = 9.0  # squared Mahalanobis distance
_BY_TURNING = 0.8  # of such an angle's variance: the object turned, rather than tapers otherwise
_FIRM = 1.0  # N of both tips, from which on an object does not rock between them
_BRIEF = 0.02  # s over which a free joint's torque is averaged, for its greatest
_UNFELT = 0.1  # s that a touch may last before it is felt
_FOLLOWED = 1.0  # responses of the cells after a touch, in which each frame begins anew
# A footprint that grows within the cells' response looks wider and flatter, by so much times the
# variance of the d that it is a mean of, over d²: by the fit of a mean of paraboloids.
_WIDER, _FLATTER, _SPREAD_MAX = 1.4, 2.0, 0.1
_STEP_VARIANCE = 1.0 / 12.0  # of a count
LAW_POINTS = 17  # over d from 0 to the radius


class Quantity(Record):
    """A tip's d [m] or the object's angle φ [rad]: carried on by joints, corrected by frames."""

    mean: float
    variance: float  # just after the last frame, drift added
    displacement: float  # sum of predicted motion
    path_length: float  # of it since the last frame's instant


class TrackedTip(Record):
    """State of the filter for one tip and its joint."""

    d: Quantity
    gain: float  # measured over modelled pressure: the frames' height
    gain_variance: float
    d_gain: float  # covariance of d and gain [m]
    before: float  # 1/variance of the gain's logarithm by the scales; 0: frames tell it, ∞: known
    power: float  # of d by F, where a frame has one amplitude for d and gain
    touched: float  # when the contact began [s]
    fresh: bool  # a frame has come that the scales have not taken in yet
    tilt_y: float
    shear: float  # along the face in the hand's plane, by a solid tip's newest frame [N]
    q: float  # tracked joint [rad]
    unseen: float  # joint motion since the last frame that the velocity can't show [rad]
    torque: float  # of the joint [N·m]
    effort: float  # likewise, averaged while nothing touches the tip [N·m]
    efforts: Pair  # the greatest lately, and before: a touch is felt later than it begins
    since: float  # the last of them began [s]
    speed: float  # of the joint [rad/s]
    shared: Pair  # the variances of d and θ that all frames share
    law: Annotated[FloatArray, LAW_POINTS]  # relative error of F by table and law, over d
    memory: Annotated[FloatArray, 3]  # the lasting force, followed by each Prony term [N]
    firmness: float  # of a tip that relaxes, over its lasting one
    in_contact: bool  # touches, and is carried on


class GraspState(Record):
    """Response of the held object to the joints at this tick, for the grip laws."""

    t: float  # when the joints were read [s]
    d: Pair  # displacements [m]
    force: Pair  # of the tips, their moduli's scale times their tables' [N]
    angle_std: float  # standard deviation of the object's angle [rad]
    taper: float  # α between the object's faces, as both tips feel them [rad]
    unexplained_rotation: Pair  # of the object, by no joint, summed, as each tip shows it [rad]
    turning: float  # ∂U/∂θ over F θ d of the tips, upright: set once
    q: Pair  # tracked joints [rad]
    moment_arm: Pair  # ∂(d1 + d2)/∂q [m]
    jacobian_rotation: Pair  # r of φ̇ = r1 q̇1 − r2 q̇2
    jacobian_slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    energy_arm: Pair  # torque over force by the energy [m]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # shear over normal force, by the object's balance, unloaded
    sheared: float  # along the faces, as solid tips' newest frames show it [N]
    twisted: float  # likewise, of a twist: alike on both faces [N]
    torque_residual: Pair  # what only a load along the faces explains of the joints' torques [N·m]
    load_arm: float  # a load L makes them arm L + curvature L²; 0: none shows [m]
    load_curvature: float  # [m/N]
    free_torque: Pair  # the most that each joint took on its way to the touch: friction's bound
    scales: Scales  # of what feels the tips' forces
    witnesses: WitnessState  # and what speaks against it


class Past(Record):
    """Predicted motion until one instant, as cells show it: a row of the history."""

    t: float
    d: Pair
    spread: Pair  # variance of the d that cells show at once [m²]
    angle: float
    q: Pair
    firmness: Pair


class FilterState(Record):
    """Constants, memory and results of the filter."""

    half_separation: float  # of the hand, in m as its other lengths
    length: float
    offset: float
    radius: float
    count: float  # of a joint's encoder [rad]
    slow: float  # half a count of velocity [rad/s]
    response: float  # of the cells [s]
    relaxation: Annotated[FloatArray, 3]  # of the tips: `tip.relaxation`, and …
    relaxation_time: Annotated[FloatArray, 3]  # … its times [s]
    torque_constant: float  # of what arrives at the tip of a joint that closes [N·m/A]
    assumed_taper: float  # `object.taper` [rad]
    alone: bool  # one finger
    gain_known: bool  # by the settings, where frames don't tell it
    t: float  # of the last reading [s]
    checked: float  # when witnesses were checked last [s]
    newest: int  # row of the history
    phase: int  # of the grip at the last tick
    tip: Annotated[Records[TrackedTip], 2]
    angle: Quantity
    taper: float  # α as found [rad]
    taper_variance: float
    taper_covariance: float  # with φ
    unexplained_rotation: Pair  # sum of what each tip's frames have corrected of φ [rad]
    grasp: GraspState


@inner_kernel
def _variance(quantity: Quantity, step: float) -> float:
    """Return the last frame's variance and that of joints read since in steps of ``step``."""
    path_length = quantity.path_length
    missed = _MOTION_ERROR * path_length
    variance: float = quantity.variance + missed * missed
    if path_length > 0.0:
        variance += min(path_length * path_length, _STEP_VARIANCE * step * step)
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
def _new_displacement(
    tip: TrackedTip, slow: float, displacement: float, measured: float, dt: float
) -> float:
    """Return the displacement of a tracked joint that the estimates have not accounted for yet.

    A joint that creeps through its count comes up by a whole one at the edge; frames have seen most
    of that before. Beyond the displacement ``measured`` by the velocity only so much is new as may
    have stayed below half a count of velocity since the last frame.
    """
    unseen = tip.unseen + slow * dt
    more = min(max(displacement - measured, -unseen), unseen)
    tip.unseen = unseen - abs(more)
    return measured + more


@inner_kernel
def _between(first: float, last: float, fraction: float) -> float:
    return first + fraction * (last - first)


@inner_kernel
def _move(quantity: Quantity, displacement: float) -> None:
    quantity.mean += displacement
    quantity.displacement += displacement
    quantity.path_length += abs(displacement)


@kernel
def predict(
    filters: Records[FilterState],
    history: Records[Past],
    t: float,
    q: Two,
    dq: Two,
    current: Two,
    goal: Two,
) -> None:
    """Predict the estimates at time ``t`` by the joints' reading [rad, rad/s, A].

    ``goal`` [A]: what a grip has the currents be, 0 without one.
    """
    f = filters[0]
    left = f.tip[0]
    right = f.tip[1]
    slower = left.speed, right.speed
    left.speed = dq[0]
    right.speed = dq[1]
    dt = t - f.t
    if dt <= 0.0:
        return
    for k in range(2):
        trusted = witnesses.trusted_current(f.grasp.witnesses, k, current[k], goal[k], dt)
        tip = f.tip[k]
        tip.torque = f.torque_constant * trusted
        if not tip.in_contact:
            _watch_effort(tip, f.grasp, k, t, dt, dq[k] - slower[k])
    f.t = t
    kept = math.exp(-dt / f.response) if f.response > 0.0 else 0.0
    if dt > HISTORY:
        dt = 0.0
        left.q = q[0]
        right.q = q[1]
    half = 0.5 * f.count
    displacement1 = min(max(left.q + dq[0] * dt, q[0] - half), q[0] + half) - left.q
    displacement2 = min(max(right.q + dq[1] * dt, q[1] - half), q[1] + half) - right.q
    seen1 = _new_displacement(left, f.slow, displacement1, dq[0] * dt, dt)
    seen2 = _new_displacement(right, f.slow, displacement2, dq[1] * dt, dt)
    both = left.in_contact and right.in_contact
    if both or f.alone:
        arm1, arm2, turn1, turn2, jacobian_slide, _, _ = _motion(f)
        if both:
            turn = turn1 * seen1 - turn2 * seen2
            deeper1 = deeper2 = 0.5 * (arm1 * seen1 + arm2 * seen2 + jacobian_slide * turn)
        else:
            turn = 0.0
            deeper1 = arm1 * seen1 if left.in_contact else 0.0
            deeper2 = arm2 * seen2 if right.in_contact else 0.0
        # What no hand can do, as by a taper of half a turn, tells nothing, and would stay for ever.
        if abs(deeper1) + abs(deeper2) < f.radius and abs(turn) < _TURN_MOST:
            _move(left.d, deeper1)
            _move(right.d, deeper2)
            _move(f.angle, turn)
            if both:  # what frames have shown before its count came
                shown1 = displacement1 - seen1
                shown2 = displacement2 - seen2
                turn = turn1 * shown1 - turn2 * shown2
                shown = 0.5 * (arm1 * shown1 + arm2 * shown2 + jacobian_slide * turn)
                f.grasp.witnesses.corrected[0] -= shown
                f.grasp.witnesses.corrected[1] -= shown
    left.q += displacement1
    right.q += displacement2
    left.d.variance += _DRIFT_D * _DRIFT_D * dt
    right.d.variance += _DRIFT_D * _DRIFT_D * dt
    for k in range(2):
        if f.gain_known or f.tip[k].before == 0.0:
            f.tip[k].gain_variance += _DRIFT_GAIN * _DRIFT_GAIN * dt
        _relax(f, k, dt)
    if both:
        scales.drift(f.grasp.scales, dt)
    f.angle.variance += _DRIFT_ANGLE * _DRIFT_ANGLE * dt
    f.taper_variance += _DRIFT_TAPER * _DRIFT_TAPER * dt
    last = history[f.newest]
    f.newest = (f.newest + 1) % len(history)
    row = history[f.newest]
    row.t = t
    row.angle = _between(f.angle.displacement, last.angle, kept)
    for k in range(2):
        row.d[k] = _between(f.tip[k].d.displacement, last.d[k], kept)
        behind = f.tip[k].d.displacement - last.d[k]
        row.spread[k] = kept * (last.spread[k] + (1.0 - kept) * behind * behind)
        row.q[k] = _between(f.tip[k].q, last.q[k], kept)
        row.firmness[k] = _between(f.tip[k].firmness, last.firmness[k], kept)


@inner_kernel
def _watch_effort(
    tip: TrackedTip, grasp: GraspState, finger: int, t: float, dt: float, faster: float
) -> None:
    """Note the greatest torque that a joint's friction took while it moved freely.

    It is ``faster`` by so much than at the last reading [rad/s]. The last moments are left out, in
    which the tip may touch already and not be felt.
    """
    accelerating = grasp.scales.inertia * faster / dt
    tip.effort += (tip.torque - accelerating - tip.effort) * min(dt / _BRIEF, 1.0)
    tip.efforts[0] = max(tip.efforts[0], abs(tip.effort))
    if t - tip.since > _UNFELT:
        grasp.free_torque[finger] = max(grasp.free_torque[finger], tip.efforts[1])
        tip.efforts[1] = tip.efforts[0]
        tip.efforts[0] = 0.0
        tip.since = t


@inner_kernel
def _relax(f: FilterState, finger: int, dt: float) -> None:
    """Let ``dt`` s pass in a tip that relaxes; set its firmness."""
    tip = f.tip[finger]
    lasting = f.grasp.force[finger] / tip.firmness if tip.in_contact else 0.0
    if not lasting < math.inf:  # beyond the tip's law
        lasting = 0.0
    firmness = 1.0
    for k in range(3):
        strength = f.relaxation[k]
        if strength == 0.0:
            continue
        tip.memory[k] += (lasting - tip.memory[k]) * -math.expm1(-dt / f.relaxation_time[k])
        firmness += strength * (1.0 - tip.memory[k] / lasting if lasting > 0.0 else 1.0)
    tip.firmness = max(firmness, _LIMP)


@inner_kernel
def _motion(f: FilterState) -> Motion:
    q = f.tip[0].q, f.tip[1].q
    d = f.tip[0].d.mean, f.tip[1].d.mean
    lengths = f.half_separation, f.length, f.offset, f.radius
    return held_motion(q, d, f.angle.mean, f.taper, lengths)


@inner_kernel
def _rows_at(history: Records[Past], newest: int, t: float) -> tuple[int, int, float]:
    """Rows before and after time ``t``, and the later one's weight; the ends for a time beyond."""
    size = len(history)
    later = newest
    for back in range(size):
        row = (newest - back) % size
        if history[row].t == -math.inf:
            break  # nothing was read before: a frame may be older than the first reading
        if history[row].t <= t:
            span = history[later].t - history[row].t
            fraction = (t - history[row].t) / span if span > 0.0 else 0.0
            return row, later, fraction
        later = row
    return later, later, 0.0


@inner_kernel
def _update_tip(
    tip: TrackedTip, step: float, d_since: float, d: float, gain: float, noise: Noise
) -> None:
    """Update d and gain by a frame, since which the joints moved d by ``d_since``.

    Its errors in both make up for each other, so the gain, which is slow, makes d the better.
    """
    own = _variance(tip.d, step)
    slow = tip.gain_variance
    joint = tip.d_gain
    by_d, by_both, by_gain = noise
    innovation = d - (tip.d.mean - d_since)
    gain_innovation = gain - tip.gain
    if innovation * innovation > _GATE * (own + by_d):
        own = innovation * innovation
        joint = 0.0
    if gain_innovation * gain_innovation > _GATE * (slow + by_gain):
        slow = gain_innovation * gain_innovation
        joint = 0.0
    total = own + by_d
    both = joint + by_both
    height = slow + by_gain
    inverse = 1.0 / max(total * height - both * both, 1e-30)
    d_by_d = (own * height - joint * both) * inverse
    d_by_gain = (joint * total - own * both) * inverse
    gain_by_d = (joint * height - slow * both) * inverse
    gain_by_gain = (slow * total - joint * both) * inverse
    tip.d.mean += d_by_d * innovation + d_by_gain * gain_innovation
    tip.gain += gain_by_d * innovation + gain_by_gain * gain_innovation
    tip.d.variance = (1.0 - d_by_d) * own - d_by_gain * joint
    tip.d_gain = (1.0 - d_by_d) * joint - d_by_gain * slow
    tip.gain_variance = (1.0 - gain_by_gain) * slow - gain_by_d * joint
    tip.d.path_length = abs(d_since)


@inner_kernel
def _update_product(
    tip: TrackedTip,
    step: float,
    d_since: float,
    d: float,
    power: float,
    by_d: float,
    turning: bool,
    holding: bool,
    corrected: float,
) -> None:
    """Update d and gain by a frame whose fit had a fixed gain: it shows d gain^(1/n), as F ∝ dⁿ.

    ``power``: 1/n. What joints and closing don't explain is d's, and when ``turning`` all is, as
    rolling is no closing, nor is what moves the object before it; when ``holding``, no more of it
    than a count of the joints hides, of which frames have ``corrected`` some lately: all else is
    the sensor's.
    """
    before = max(tip.d.mean - d_since, _D_MIN)
    gain = tip.gain
    # All of the logarithms, in which the frame's is straight.
    own = _variance(tip.d, step) / (before * before)
    joint = tip.d_gain / (before * gain)
    slow = tip.gain_variance / (gain * gain)
    noise = by_d / (d * d)
    innovation = math.log(d / before) - power * math.log(gain)
    total = own + power * (2.0 * joint + power * slow) + noise
    jumped = innovation * innovation > _GATE * total
    if holding:
        jumped = jumped and abs(innovation) * before > 2.0 * step
    if jumped and holding:
        slow += innovation * innovation / (power * power)
    elif jumped:
        own += innovation * innovation
    total = own + power * (2.0 * joint + power * slow) + noise
    d_weight = (own + power * joint) / total
    gain_weight = (joint + power * slow) / total
    if turning or (holding and not jumped):
        gain_weight = 0.0  # no closing tells it
    after = before * math.exp(d_weight * innovation)
    kept = after
    if holding:
        deepest = before - corrected + step
        kept = min(max(after, deepest - 2.0 * step), deepest)
    gain *= math.exp(gain_weight * innovation) * (after / kept) ** (1.0 / power)
    tip.d.mean = kept + d_since
    tip.gain = gain
    tip.d.variance = kept * kept * (own - d_weight * (own + power * joint))
    tip.d_gain = kept * gain * (joint - d_weight * (joint + power * slow))
    slow -= gain_weight * gain_weight * total
    tip.gain_variance = gain * gain * slow
    tip.d.path_length = abs(d_since)


@inner_kernel
def _update_angle(
    f: FilterState, sense: float, angle_since: float, found: float, variance: float
) -> None:
    """Update φ and α by the angle of one face that a frame ``found``, ``angle_since`` ago."""
    own = _variance(f.angle, f.count)
    joint = f.taper_covariance
    spread = f.taper_variance
    innovation = found - (f.angle.mean + 0.5 * sense * f.taper - angle_since)
    if innovation * innovation > _GATE * (_face_variance(f, sense) + variance):
        own += _BY_TURNING * innovation * innovation
        spread += 4.0 * (1.0 - _BY_TURNING) * innovation * innovation
    by_angle = own + 0.5 * sense * joint
    by_taper = joint + 0.5 * sense * spread
    inverse = 1.0 / (by_angle + 0.5 * sense * by_taper + variance)
    f.angle.mean += by_angle * inverse * innovation
    f.taper += by_taper * inverse * innovation
    f.angle.variance = own - by_angle * by_angle * inverse
    f.taper_covariance = joint - by_angle * by_taper * inverse
    f.taper_variance = spread - by_taper * by_taper * inverse
    f.angle.path_length = abs(angle_since)


@kernel
def update(
    filters: Records[FilterState],
    history: Records[Past],
    finger: int,
    t: float,
    found: tuple[float, float, float, float, float],
    covariance: FloatArray,
    systematic: FloatArray,
    table: FloatArray,
) -> bool:
    """Update by one finger's frame of time ``t``: d, θ, tilt_y, gain, shear and their covariance.

    ``systematic`` is the part of it that all frames share: it is no reason to wait for more.
    Returns False for a frame that is refused, since what it shows can't be.
    """
    f = filters[0]
    tip = f.tip[finger]
    other = f.tip[1 - finger]
    d, theta, tilt_y, gain, shear = found
    known = tip.d.mean + tip.gain + f.angle.mean + f.taper + f.unexplained_rotation[finger]
    if not abs(known) < math.inf:  # begin anew
        tip.in_contact = other.in_contact = False
        f.unexplained_rotation[:] = 0.0
    theta_variance = covariance[1, 1] - systematic[1, 1]
    noise = (
        covariance[0, 0] - systematic[0, 0],
        covariance[0, 3] - systematic[0, 3],
        covariance[3, 3] - systematic[3, 3],
    )
    row, later, fraction = _rows_at(history, f.newest, t)
    before = history[row]
    after = history[later]
    d_since = tip.d.displacement - _between(before.d[finger], after.d[finger], fraction)
    angle_since = f.angle.displacement - _between(before.angle, after.angle, fraction)
    q = _between(before.q[finger], after.q[finger], fraction)
    angle = theta - q if finger == 0 else theta + q
    sense = -1.0 if finger == 0 else 1.0
    angle_variance = theta_variance + _STEP_VARIANCE * f.count * f.count
    both = tip.in_contact and other.in_contact
    firmness = _between(before.firmness[finger], after.firmness[finger], fraction)
    free = covariance[3, 3] > 0.0 or f.gain_known
    power = 0.0  # of d by F, where the frame has one amplitude for d and gain
    spread = _between(before.spread[finger], after.spread[finger], fraction) / (d * d)
    if covariance[3, 3] > 0.0:
        gain /= firmness * (1.0 - _FLATTER * min(spread, _SPREAD_MAX))
        d /= 1.0 + _WIDER * min(spread, _SPREAD_MAX)
    else:
        force, _, stiffness, _, _, _, _ = lookup(table, d, total_tilt(theta, tilt_y))
        power = force / (stiffness * d)
        d *= firmness**-power
    if both:
        tip.d.mean = max(tip.d.mean - witnesses.set_aside(f.grasp.witnesses, finger), _D_MIN)
    if both and min(f.grasp.normal[0], f.grasp.normal[1]) > _FIRM:
        innovation = angle - (f.angle.mean + 0.5 * sense * f.taper - angle_since)
        if witnesses.refuses(
            f.grasp.witnesses,
            finger,
            innovation,
            _face_variance(f, sense) + angle_variance,
            d - (tip.d.mean - d_since) if covariance[3, 3] > 0.0 else 0.0,
            _variance(tip.d, f.count * f.length) + noise[0],
            abs(tip.speed) + abs(other.speed),
        ):
            return False
    tip.unseen = min(tip.unseen, f.slow * (max(f.t - t, 0.0) + f.response))
    tip.tilt_y = tilt_y
    tip.shear = shear
    tip.power = power
    tip.shared[0] = systematic[0, 0]
    tip.shared[1] = systematic[1, 1]
    if not free:  # the gain's part is the filter's own
        of_gain = power * d * f.grasp.scales.prior[scales.GAIN + finger] ** 0.5
        tip.shared[0] = max(systematic[0, 0] - of_gain * of_gain, 0.0)
    if not tip.in_contact:
        tip.touched = f.t
    # Cells that still follow the touch show motion of before it, which no history has.
    early = f.t - tip.touched < _FOLLOWED * f.response
    tip.fresh = not early
    if free and (early or not tip.in_contact):
        tip.gain = gain
        tip.d.mean = d + d_since
        tip.d.variance, tip.d_gain, tip.gain_variance = noise
        tip.d.path_length = abs(d_since)
    if not tip.in_contact:
        tip.in_contact = True
        tip.before = math.inf if covariance[3, 3] == 0.0 else 0.0
        if not free:
            tip.gain, relative = scales.height(f.grasp.scales, finger)
            tip.gain_variance = relative * tip.gain * tip.gain
            tip.before = 1.0 / relative
            alone = d / tip.gain**power
            slope = -power * alone / tip.gain
            tip.d.mean = alone + d_since
            tip.d.variance = noise[0] + slope * slope * tip.gain_variance
            tip.d_gain = slope * tip.gain_variance
        tip.d.path_length = abs(d_since)
        f.grasp.scales.gripping = False
        witnesses.forget(f.grasp.witnesses)
        if not other.in_contact:
            _assume_taper(f, sense, angle + angle_since, angle_variance)
            f.angle.path_length = abs(angle_since)
        else:
            face = f.angle.mean - 0.5 * sense * f.taper
            _assume_taper(f, -sense, face, _face_variance(f, -sense))
            _update_angle(f, sense, angle_since, angle, angle_variance)
        return True
    before_it = tip.d.mean
    if f.grasp.witnesses.off[finger] != 0.0:
        tip.fresh = False  # the joints tell d
    elif free and not early:
        _update_tip(tip, f.count * f.length, d_since, d, gain, noise)
    elif not free:
        _update_product(
            tip,
            f.count * f.length,
            d_since,
            d,
            power,
            noise[0],
            f.phase == OTHER if both else not f.alone,
            both and f.phase == HOLDING,
            f.grasp.witnesses.corrected[finger],
        )
    f.grasp.witnesses.corrected[finger] += tip.d.mean - before_it
    predicted = f.angle.mean
    _update_angle(f, sense, angle_since, angle, angle_variance)
    f.unexplained_rotation[finger] += f.angle.mean - predicted
    return True


@inner_kernel
def _law_error(tip: TrackedTip, fraction: float) -> float:
    """Relative error of F by table and law; ``fraction`` is d over the tip's radius."""
    t = min(max(fraction, 0.0), 1.0) * (LAW_POINTS - 1.001)
    k = int(t)
    error: float = tip.law[k] + (t - k) * (tip.law[k + 1] - tip.law[k])
    return error


@inner_kernel
def _write_tip(f: FilterState, finger: int, theta: float, table: FloatArray) -> Tip:
    tip = f.tip[finger]
    grasp = f.grasp
    tilt = total_tilt(theta, tip.tilt_y)
    force, energy, stiffness, by_tilt, _, _, inside = lookup(table, tip.d.mean, tilt)
    grasp.q[finger] = tip.q
    grasp.d[finger] = max(tip.d.mean, 0.0)
    modulus = f.grasp.scales.modulus[finger] * tip.firmness
    grasp.force[finger] = modulus * force
    grasp.stiffness[finger] = modulus * stiffness
    d_variance = _variance(tip.d, f.count * f.length) + tip.shared[0]
    theta_variance = _face_variance(f, -1.0 if finger == 0 else 1.0) + tip.shared[1]
    along = theta / tilt if tilt > 0.0 else 0.0
    law = _law_error(tip, tip.d.mean / f.radius)
    at = scales.MODULUS + finger
    relative = grasp.scales.covariance[at, at] + law * law
    force_variance = (
        (modulus * stiffness) ** 2 * d_variance
        + (modulus * by_tilt * along) ** 2 * theta_variance
        + relative * grasp.force[finger] ** 2
    )
    return (
        grasp.d[finger],
        theta,
        grasp.force[finger],
        modulus * energy,
        math.sqrt(d_variance),
        math.sqrt(theta_variance),
        math.sqrt(force_variance),
        inside,
    )


@inner_kernel
def _learn_scales(f: FilterState, ramping: bool) -> None:
    """Take in what this tick's frames and joints say of the scales."""
    s = f.grasp.scales
    grasp = f.grasp
    both = f.tip[0].in_contact and f.tip[1].in_contact
    s.doubted = s.doubted or witnesses.doubts(grasp.witnesses)
    if both and not s.gripping:
        scales.begin_grip(s, f.response > 0.0)
        for k in range(2):  # or else it would count for evidence how far back the scales have gone
            if 0.0 < f.tip[k].before < math.inf:
                _take_height(f.tip[k], s, k)
    news = False
    for k in range(2):
        tip = f.tip[k]
        if not (tip.fresh and tip.in_contact):
            continue
        tip.fresh = False
        news = True
        s.product[k] = 1.0 if 0.0 < tip.before < math.inf else 0.0
        if tip.before < math.inf:
            relative = max(tip.gain_variance / (tip.gain * tip.gain), 1e-12)
            known = tip.before if ramping else 0.0
            scales.update_height(s, k, tip.gain, relative, known)
    if not news:
        return
    if both and ramping and grasp.load_arm > 0.0:
        for k in range(2):
            s.torque[k] = f.tip[k].torque
            s.moment[k] = s.torque[k] / (1.0 + s.mean[scales.TORQUE + k]) - grasp.torque_residual[k]
        scales.update_torque(s, s.torque, s.moment, 0.5 * (f.tip[0].speed + f.tip[1].speed), f.t)
        scales.update_balance(s, grasp.normal[0], grasp.normal[1])
    for k in range(2):
        if ramping and f.tip[k].in_contact and s.product[k] > 0.0:
            _take_height(f.tip[k], s, k)
    scales.settle(s)


@inner_kernel
def _take_height(tip: TrackedTip, s: Scales, finger: int) -> None:
    """Take the gain that torques have told of, too; d is what the frames' amplitude leaves."""
    alone = tip.d.variance - tip.d_gain * tip.d_gain / tip.gain_variance
    gain, relative = scales.height(s, finger)
    tip.d.mean *= (tip.gain / gain) ** tip.power
    slope = tip.power * tip.d.mean
    tip.d.variance = max(alone, 0.0) + slope * slope * relative
    tip.d_gain = -slope * gain * relative
    tip.gain = gain
    tip.gain_variance = gain * gain * relative
    tip.before = 1.0 / relative


@kernel
def write_grasp(
    filters: Records[FilterState], table1: FloatArray, table2: FloatArray, phase: int
) -> tuple[Tip, Tip, float, float]:
    """Write what the estimates mean into ``grasp``; ``phase``: of the grip, as below `HISTORY`.

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
    grasp.unexplained_rotation[:] = f.unexplained_rotation
    arm1, arm2, turn1, turn2, grasp.jacobian_slide, width, _ = motion
    grasp.moment_arm[0] = arm1
    grasp.moment_arm[1] = arm2
    grasp.jacobian_rotation[0] = turn1
    grasp.jacobian_rotation[1] = turn2
    d = left.d.mean, right.d.mean
    theta = theta1, theta2
    lever1, lever2, shear, normal1, normal2 = holding_levers(
        table1, table2, d, theta, taper, motion
    )
    out_of_grip = 0.5 * math.tan(0.5 * taper) * (normal1 + normal2)
    grasp.energy_arm[0] = lever1
    grasp.energy_arm[1] = lever2
    grasp.shear = 0.0
    if normal1 + normal2 > 0.0:
        grasp.shear = 2.0 * (abs(shear) + abs(out_of_grip)) / (normal1 + normal2)
    modulus1 = f.grasp.scales.modulus[0] * left.firmness
    modulus2 = f.grasp.scales.modulus[1] * right.firmness
    grasp.normal[0] = modulus1 * normal1
    grasp.normal[1] = modulus2 * normal2
    rolled = (shear - out_of_grip, shear + out_of_grip)
    means = grasp.scales.mean
    torque1 = left.torque / (1.0 + means[scales.TORQUE])
    torque2 = right.torque / (1.0 + means[scales.TORQUE + 1])
    torques = torque1 / modulus1, torque2 / modulus2
    remaining1, remaining2, grasp.load_arm, curvature = load_torques(
        table1, table2, d, theta, taper, motion, rolled, torques
    )
    # A pull's forces on the two faces are opposite, a twist's alike; both must show them.
    both = math.copysign(min(abs(left.shear), abs(right.shear)), left.shear)
    grasp.sheared = both if left.shear * right.shear < 0.0 else 0.0
    grasp.twisted = both - grasp.sheared
    grasp.torque_residual[0] = modulus1 * remaining1
    grasp.torque_residual[1] = modulus2 * remaining2
    grasp.load_curvature = 2.0 * curvature / (modulus1 + modulus2)
    _learn_scales(f, phase == RAMPING)
    if phase == HOLDING:
        scales.keep(grasp.scales)
    elif phase == RAMPING:
        grasp.scales.proven = False
    if grasp.load_arm > 0.0:
        dt = f.t - f.checked
        if phase == HOLDING and f.phase != HOLDING:
            witnesses.begin_holding(grasp.witnesses, grasp.torque_residual)
        for k in range(2):
            grasp.torque_residual[k] = witnesses.check_drift(
                f.grasp.witnesses,
                k,
                grasp.torque_residual[k],
                f.tip[k].torque - grasp.torque_residual[k],
                grasp.moment_arm[k] * grasp.stiffness[k],
                abs(f.tip[k].speed) < witnesses.QUIET,
                phase == HOLDING,
                min(dt, HISTORY),
            )
    f.phase = phase
    f.checked = f.t
    return seen1, seen2, angle, width
