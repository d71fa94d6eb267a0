"""The state that perception estimates, its prediction by the joints, and how a channel corrects it.

One Kalman filter holds everything that the settings do not know exactly of a hand that touches
something. `docs/estimation.md` derives the model and says which manoeuvre shows what.

State         Unit   Meaning, and what moves it
D             m      displacement of each tip: closing joints, an object that shifts sideways
ENCODER       rad    true joint angle over the tracked one: a count hides so much
DRIFT         m      what frames show beyond D: a zero that moves
SHIFT         rad    likewise of the angle: an image that moves
MODULUS       –      logarithm of each tip's modulus over the settings': fixed in a grip
GAIN          –      logarithm of each sensor's gain: warmth moves it
TORQUE        –      each joint's torque over what its current says, less 1: fixed
ANGLE, TAPER  rad    of the object's faces: rolling
LATENCY       s      how much older frames are than `tactile.latency` says: fixed
FRICTION      N·m    torque of the joints' mean that does not grow with the grip

Pairs are (left, right), at index and index + 1. SI units.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.grasp import GraspState
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records
from softfinger.kinematics.hand.grasp_state import Motion, Two, held_motion

FloatArray = NDArray[np.float64]

STATES = 18
D, ENCODER, DRIFT, SHIFT, MODULUS, GAIN, TORQUE = 0, 2, 4, 6, 8, 10, 12
ANGLE, TAPER, LATENCY, FRICTION = 14, 15, 16, 17

HISTORY = 0.5  # s of joint motion stored: an older frame is taken as so old
CURRENT_TIME = 0.1  # s for which a current may be off its goal
LAW_POINTS = 17  # over d from 0 to the radius

# Random walks of a grip, per √s.
_WALK_CLOSING = 2e-5  # m of the tips' sum that no joint makes: an object's width is what it is
_WALK_SIDEWAYS = 3e-4  # m of one tip in which the other gives way: the object is free
_WALK_UNTOLD = 3e-5  # m, likewise, where frames tell it but with force and gain
_WALK_LOOSE = 5e-3  # m and …
_WALK_SWAYING = 2e-2  # … rad of an object that one tip alone touches
_WALK_ANGLE = 2e-4  # rad: creep
_WALK_DRIFT = 1e-4  # m, what a zero does that warms up
_WALK_SHIFT = 1e-3  # rad
_WALK_GAIN = 0.05  # warmth, creep; …
_WALK_PRODUCT = 0.01  # … where frames tell nothing of it but with the force
_WALK_FRICTION = 0.05  # N·m
_MOTION_ERROR = 0.05  # of what rolling turns an object by, and closing presses the tips …
_SHIFT_ERROR = 0.1  # … and, of fingers that move to one side, what may shift it between the tips, …
_MOTION_TIME = 0.1  # … for so long [s]
_VELOCITY_TIME = 0.02  # s for which a velocity's error stays the same
_VARIANCE_OF_COUNT = 1.0 / 12.0
_LEAST = 1e-6  # part of a variance that one measurement leaves: rounding takes none below 0
_TORQUE_MOST = 0.3  # beyond which no torque constant is off
_LATENCY_MOST = 0.15  # s
_BRIEF = 0.02  # s over which a free joint's torque is averaged, for its greatest
_UNFELT = 0.1  # s that a touch may last before it is felt
_CURRENT_OFF = 0.25  # fraction of its goal that a current may be off …
_CURRENT_NOISE = 0.02  # … and A besides
_TURN_MOST = 1.0  # rad from reading to reading: more no hand can do
_LIMP = 0.02  # least firmness, of a tip that comes back late


class TrackedTip(Record):
    """One finger: what is known of it beside the state."""

    in_contact: bool  # touches
    touched: float  # when the contact began [s]
    fresh: bool  # a frame has come that the torques have not been compared with
    tilt_y: float
    steepness: float  # ∂ ln F/∂d at the d of its newest frame [1/m]
    product: bool  # its frames show the product of force and gain
    off: float  # what the newest frame's d was off its prediction [m]
    shear: float  # along the face in the hand's plane, by a solid tip's newest frame [N]
    shared: Pair  # the variances of d and θ that all frames share
    q: float  # tracked joint [rad]
    read: float  # as the encoder showed it last [rad]
    speed: float  # of the joint [rad/s]
    torque: float  # of the joint [N·m]
    effort: float  # likewise, averaged while nothing touches the tip [N·m]
    efforts: Pair  # the greatest lately, and before: a touch is felt later than it begins
    since: float  # the last of them began [s]
    travelled: Pair  # sums of predicted motion: of d [m], of the joint [rad]
    law: Annotated[FloatArray, LAW_POINTS]  # relative error of F by table and law, over d
    memory: Annotated[FloatArray, 3]  # the lasting force, followed by each Prony term [N]
    firmness: float  # of a tip that relaxes, over its lasting one


class Past(Record):
    """Predicted motion until one instant, as cells show it: a row of the history."""

    t: float
    d: Pair
    spread: Pair  # variance of the d that cells show at once [m²]
    angle: float
    q: Pair
    firmness: Pair


class HandFilter(Record):
    """State, covariance, constants and results of the estimator."""

    mean: Annotated[FloatArray, STATES]
    covariance: Annotated[FloatArray, STATES, STATES]
    expected: Annotated[FloatArray, STATES]  # means before anything touches, and …
    prior: Annotated[FloatArray, STATES]  # … variances
    slopes: Annotated[FloatArray, STATES]  # of a measurement by the states; 0 between them
    cross: Annotated[FloatArray, STATES]  # scratch
    half_separation: float  # of the hand, in m as its other lengths
    length: float
    offset: float
    radius: float
    count: float  # of a joint's encoder [rad]
    velocity_unit: float  # [rad/s]
    latency: float  # of frames, as set [s]
    response: float  # of the cells [s]
    relaxation: Annotated[FloatArray, 3]  # of the tips: `tip.relaxation`, and …
    relaxation_time: Annotated[FloatArray, 3]  # … its times [s]
    torque_constant: float  # of what arrives at the tip of a joint that closes [N·m/A]
    inertia: float  # of a joint [kg·m²]
    held: float  # share of the tips' moment that gears hold while the torque goes back
    alone: bool  # one finger
    gain_known: bool  # by the settings, where frames don't tell it
    t: float  # of the last reading [s]
    newest: int  # row of the history
    turned: float  # sum of the predicted rotation [rad]
    closing: float  # mean speed of both joints, averaged [rad/s]
    opening: float  # likewise, a tick before
    most: float  # greatest mean torque of the grip [N·m]
    compared: float  # when torques and forces were compared last [s]
    tip: Annotated[Records[TrackedTip], 2]
    grasp: GraspState


# --- correction -----------------------------------------------------------------------------------


@inner_kernel
def expected_variance(h: HandFilter) -> float:
    """Variance of what `slopes` measure; leaves the covariance with it in `cross`."""
    expected = 0.0
    for i in range(STATES):
        total = 0.0
        for j in range(STATES):
            total += h.covariance[i, j] * h.slopes[j]
        h.cross[i] = total
        expected += h.slopes[i] * total
    return max(expected, 0.0)


@inner_kernel
def correct(h: HandFilter, innovation: float, variance: float, gate: float) -> None:
    """Correct the state by one measurement's ``innovation``, with `slopes` by the states.

    ``variance``: of its noise. Beyond a ``gate`` [standard deviations] it counts as if it were
    so far off: nobody is believed alone. What is not finite tells nothing. Leaves the slopes 0.
    """
    expected = expected_variance(h)
    variance = max(variance, innovation * innovation / (gate * gate) - expected, _LEAST * expected)
    total = expected + variance
    if 0.0 < total < math.inf and abs(innovation) < math.inf:
        inverse = 1.0 / total
        for i in range(STATES):
            gain = h.cross[i] * inverse
            h.mean[i] += gain * innovation
            for j in range(STATES):
                h.covariance[i, j] -= gain * h.cross[j]
        for k in range(2):
            off = h.mean[TORQUE + k] - h.expected[TORQUE + k]
            h.mean[TORQUE + k] -= off - min(max(off, -_TORQUE_MOST), _TORQUE_MOST)
        h.mean[LATENCY] = min(max(h.mean[LATENCY], -h.latency), _LATENCY_MOST)
    h.slopes[:] = 0.0


@inner_kernel
def forget(h: HandFilter, state: int, mean: float, variance: float) -> None:
    """Let one state be known by nothing but this ``mean`` and ``variance``."""
    h.covariance[state, :] = 0.0
    h.covariance[:, state] = 0.0
    h.covariance[state, state] = variance
    h.mean[state] = mean


@inner_kernel
def begin(h: HandFilter) -> None:
    """Begin with what was known before anything touched."""
    for state in range(STATES):
        forget(h, state, h.expected[state], h.prior[state])
    h.most = 0.0


# --- prediction -----------------------------------------------------------------------------------


@inner_kernel
def motion_of(h: HandFilter) -> Motion:
    """Return how joints move the held object, as `hand.grasp_state.held_motion`."""
    q = h.tip[0].q, h.tip[1].q
    d = h.mean[D], h.mean[D + 1]
    lengths = h.half_separation, h.length, h.offset, h.radius
    return held_motion(q, d, h.mean[ANGLE], h.mean[TAPER], lengths)


@inner_kernel
def _walk(h: HandFilter, state: int, per_root_second: float, dt: float) -> None:
    h.covariance[state, state] += per_root_second * per_root_second * dt


@inner_kernel
def _walk_pair(h: HandFilter, state: int, together: float, apart: float, dt: float) -> None:
    """Let a pair walk: both alike, and one against the other."""
    alike = together * together * dt
    other = apart * apart * dt
    h.covariance[state, state] += alike + other
    h.covariance[state + 1, state + 1] += alike + other
    h.covariance[state, state + 1] += alike - other
    h.covariance[state + 1, state] += alike - other


@kernel
def predict(
    hands: Records[HandFilter],
    history: Records[Past],
    t: float,
    q: Two,
    dq: Two,
    current: Two,
    goal: Two,
) -> None:
    """Predict the state at time ``t`` by the joints' reading [rad, rad/s, A].

    ``goal`` [A]: what a grip has the currents be, 0 without one.
    """
    h = hands[0]
    left = h.tip[0]
    right = h.tip[1]
    slower = left.speed, right.speed
    left.speed = dq[0]
    right.speed = dq[1]
    dt = t - h.t
    if dt <= 0.0:
        return
    for k in range(2):
        tip = h.tip[k]
        tip.torque = h.torque_constant * _trusted_current(h.grasp, k, current[k], goal[k], dt)
        if not tip.in_contact:
            _watch_effort(h, k, t, dt, dq[k] - slower[k])
    h.t = t
    kept = math.exp(-dt / h.response) if h.response > 0.0 else 0.0
    if dt > HISTORY:
        dt = 0.0
        left.q = left.read = q[0]
        right.q = right.read = q[1]
    h.opening = h.closing
    h.closing += (0.5 * (dq[0] + dq[1]) - h.closing) * min(dt / _VELOCITY_TIME, 1.0)
    _move(h, dq, dt)
    if left.in_contact or right.in_contact:
        _let_pass(h, dt)
    for k in range(2):
        _read_encoder(h, k, q[k], abs(dq[k]) * dt)
        _relax(h, k, dt)
    last = history[h.newest]
    h.newest = (h.newest + 1) % len(history)
    row = history[h.newest]
    row.t = t
    row.angle = _between(h.turned, last.angle, kept)
    for k in range(2):
        tip = h.tip[k]
        row.d[k] = _between(tip.travelled[0], last.d[k], kept)
        behind = tip.travelled[0] - last.d[k]
        row.spread[k] = kept * (last.spread[k] + (1.0 - kept) * behind * behind)
        row.q[k] = _between(tip.travelled[1], last.q[k], kept)
        row.firmness[k] = _between(tip.firmness, last.firmness[k], kept)


@inner_kernel
def _between(first: float, last: float, fraction: float) -> float:
    return first + fraction * (last - first)


@inner_kernel
def _move(h: HandFilter, dq: Two, dt: float) -> None:
    """Move joints, tips and object by the velocities ``dq`` [rad/s] that are read."""
    left = h.tip[0]
    right = h.tip[1]
    # A tip that doesn't touch yet comes nearer by as much as it would press deeper.
    both = not h.alone
    arm1, arm2, turn1, turn2, slide, _, _ = motion_of(h)
    if both:
        by1 = 0.5 * (arm1 + slide * turn1)
        by2 = 0.5 * (arm2 - slide * turn2)
    else:
        by1 = arm1
        by2 = arm2
    if not (left.in_contact and right.in_contact):
        turn1 = turn2 = 0.0
    moved1 = dq[0] * dt
    moved2 = dq[1] * dt
    deeper1 = by1 * moved1 + by2 * moved2 if both else by1 * moved1
    deeper2 = deeper1 if both else by2 * moved2
    turn = turn1 * moved1 - turn2 * moved2
    left.q += moved1
    right.q += moved2
    left.travelled[1] += moved1
    right.travelled[1] += moved2
    # What no hand can do, as by a taper of half a turn, tells nothing, and would stay for ever.
    if not (abs(deeper1) + abs(deeper2) < h.radius and abs(turn) < _TURN_MOST):
        return
    left.travelled[0] += deeper1
    right.travelled[0] += deeper2
    h.turned += turn
    if left.in_contact:
        h.mean[D] += deeper1
    if right.in_contact:
        h.mean[D + 1] += deeper2
    h.mean[ANGLE] += turn
    if dt > 0.0:
        rolled = _MOTION_ERROR * turn
        pressed = _MOTION_ERROR * deeper1
        shifted = 0.5 * _SHIFT_ERROR * (arm1 * moved1 - arm2 * moved2)
        lasting = _MOTION_TIME / dt
        h.covariance[ANGLE, ANGLE] += rolled * rolled * lasting
        _walk_pair(h, D, pressed, shifted, lasting)
    for k in range(2):
        # What the velocity's unit hides of a joint's motion moves encoder, tips and object alike.
        hidden = h.velocity_unit * h.velocity_unit * _VARIANCE_OF_COUNT
        variance = hidden * _VELOCITY_TIME * dt
        h.cross[:] = 0.0
        h.cross[ENCODER + k] = 1.0
        h.cross[ANGLE] = turn1 if k == 0 else -turn2
        by = by1 if k == 0 else by2
        if both or k == 0:
            h.cross[D] = by
        if both or k == 1:
            h.cross[D + 1] = by
        for i in (D, D + 1, ENCODER + k, ANGLE):
            for j in (D, D + 1, ENCODER + k, ANGLE):
                h.covariance[i, j] += variance * h.cross[i] * h.cross[j]


@inner_kernel
def _let_pass(h: HandFilter, dt: float) -> None:
    """Let ``dt`` s pass in a contact: everything becomes less certain."""
    both = h.tip[0].in_contact and h.tip[1].in_contact
    if both or h.alone:
        told = not (h.tip[0].product and h.tip[1].product)
        sideways = _WALK_SIDEWAYS if told else _WALK_UNTOLD
        _walk_pair(h, D, _WALK_CLOSING, sideways if both else 0.0, dt)
        for k in range(2):
            _walk(h, DRIFT + k, _WALK_DRIFT, dt)
            _walk(h, SHIFT + k, _WALK_SHIFT, dt)
    else:
        _walk_pair(h, D, _WALK_LOOSE, _WALK_LOOSE, dt)
    _walk(h, ANGLE, _WALK_ANGLE if both or h.alone else _WALK_SWAYING, dt)
    _walk(h, FRICTION, _WALK_FRICTION, dt)
    for k in range(2):
        _walk(h, GAIN + k, _WALK_PRODUCT if h.tip[k].product else _WALK_GAIN, dt)


@inner_kernel
def _read_encoder(h: HandFilter, finger: int, q: float, moved: float) -> None:
    """Correct by what the encoder shows: an edge where its count changes, else a count at most.

    ``moved`` [rad]: by the velocity, since the last reading.
    """
    tip = h.tip[finger]
    at = ENCODER + finger
    jumped = q - tip.read
    tip.read = q
    half = 0.5 * h.count
    if abs(jumped) > 0.5 * h.count:
        # The edge was passed since the last reading; of several, the last but one count is known.
        found = q - math.copysign(half, jumped)
        spread = max(moved, 0.05 * h.count) if abs(jumped) < 1.5 * h.count else h.count
    elif abs(q - tip.q) > half:
        found = q - math.copysign(half, q - tip.q)
        spread = h.count
    elif h.covariance[at, at] > 2.0 * _VARIANCE_OF_COUNT * h.count * h.count:
        found = q
        spread = h.count
    else:
        return
    h.slopes[at] = 1.0
    correct(h, found - tip.q, _VARIANCE_OF_COUNT * spread * spread, math.inf)
    tip.q += h.mean[at]
    h.mean[at] = 0.0
    if abs(q - tip.q) > half:
        tip.q = q - math.copysign(half, q - tip.q)


@inner_kernel
def _watch_effort(h: HandFilter, finger: int, t: float, dt: float, faster: float) -> None:
    """Note the greatest torque that a joint's friction took while it moved freely.

    It is ``faster`` by so much than at the last reading [rad/s]. The last moments are left out, in
    which the tip may touch already and not be felt.
    """
    tip = h.tip[finger]
    accelerating = h.inertia * faster / dt
    tip.effort += (tip.torque - accelerating - tip.effort) * min(dt / _BRIEF, 1.0)
    tip.efforts[0] = max(tip.efforts[0], abs(tip.effort))
    if t - tip.since > _UNFELT:
        h.grasp.free_torque[finger] = max(h.grasp.free_torque[finger], tip.efforts[1])
        tip.efforts[1] = tip.efforts[0]
        tip.efforts[0] = 0.0
        tip.since = t


@inner_kernel
def _trusted_current(
    grasp: GraspState, finger: int, current: float, goal: float, dt: float
) -> float:
    """Return a joint's current [A]: its ``goal`` in a grip, as it was read without one.

    Notes for how long the two have been apart.
    """
    if goal <= 0.0:
        grasp.off_goal[finger] = 0.0
        return current
    if abs(current - goal) <= _CURRENT_OFF * goal + _CURRENT_NOISE:
        grasp.off_goal[finger] = 0.0
    else:
        grasp.off_goal[finger] += dt
    return goal


@inner_kernel
def _relax(h: HandFilter, finger: int, dt: float) -> None:
    """Let ``dt`` s pass in a tip that relaxes; set its firmness."""
    tip = h.tip[finger]
    lasting = h.grasp.force[finger] / tip.firmness if tip.in_contact else 0.0
    if not lasting < math.inf:  # beyond the tip's law
        lasting = 0.0
    firmness = 1.0
    for k in range(3):
        strength = h.relaxation[k]
        if strength == 0.0:
            continue
        tip.memory[k] += (lasting - tip.memory[k]) * -math.expm1(-dt / h.relaxation_time[k])
        firmness += strength * (1.0 - tip.memory[k] / lasting if lasting > 0.0 else 1.0)
    tip.firmness = max(firmness, _LIMP)
