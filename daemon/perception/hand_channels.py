"""The channels that correct the hand's state: each a measurement with its noise, and a check.

Channel      Measures, of the state                                         Noise
angle        φ ∓ α/2 + SHIFT ± q − θ̇ LATENCY                                the frame's
footprint    D + DRIFT − ḋ LATENCY; a frame that was fitted with a fixed    the frame's
             gain shows ln F_table(D, θ) + MODULUS + GAIN
height       MODULUS + GAIN, where the fit has a gain of its own            2 % and the frame's
torque       mean over joints of (1 + TORQUE) · moment of the tips' forces  0.05 N·m
             + FRICTION + inertia, while both joints close
balance      ln of the tips' normal forces, which are equal                 5 % and 0.4 N

A frame shows the hand as it was when it was scanned: what joints have moved since is taken off by
the history. Its noise is what frames don't share; what they share widens the published deviations
and is never estimated. The force is ρ e^MODULUS F_table(D, θ), ρ a relaxing tip's firmness.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.perception.hand_state import (
    ANGLE,
    CURRENT_TIME,
    DRIFT,
    ENCODER,
    FRICTION,
    GAIN,
    LATENCY,
    LAW_POINTS,
    MODULUS,
    SHIFT,
    STATES,
    TAPER,
    TORQUE,
    D,
    HandFilter,
    Past,
    TrackedTip,
    begin,
    correct,
    expected_variance,
    forget,
    motion_of,
)
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import (
    holding_levers,
    load_torques,
    total_tilt,
)

FloatArray = NDArray[np.float64]
Tip = tuple[float, float, float, float, float, float, float, bool]  # of `write_grasp`

JUMP = 0.12  # rad beyond the joints' prediction in one frame: honest ones stay below 0.04
DEEPER = 1e-3  # m, likewise
JUMPS_MAX = 2  # frames that are refused before it is reported
_SURE = 5.0  # standard deviations, likewise
_ALIKE = 0.5  # fraction of it that the other tip shows of what is real
_TURNING = 0.1  # rad/s of both joints together, or …
_GOES_ON = 0.06  # … rad from frame to frame, likewise
_GIVE_UP = 50  # frames after which the contact is taken as they show it
_FIRM = 1.0  # N of both tips, from which on an object does not rock between them
_GATE = 3.0  # standard deviations: what is further off counts as no more than so much
_D_MIN = 1e-5  # m that touches
_RATE_TIME = 0.005  # s at least over which the speed of d and θ is taken
_FOLLOWED = 1.0  # responses of the cells after a touch, in which each frame begins anew
# A footprint that grows within the cells' response looks wider and flatter, by so much times the
# variance of the d that it is a mean of, over d²: by the fit of a mean of paraboloids.
_WIDER, _FLATTER, _SPREAD_MAX = 1.4, 2.0, 0.1
_STEEP_KEPT = 0.9  # of a slope, from frame to frame: what has the frame's own noise misleads
_HEIGHT_ERROR = 0.02  # of a frame's height, by all that the model leaves out
_HEIGHTS = 1e-3, 1e3  # of frames over the model's, beyond which it is no height
_UNKNOWN_D = 0.5  # of a first frame's d, …
_UNKNOWN_ANGLE = 1.0  # … and rad, before it is taken in
_TORQUE_NOISE = 0.05  # N·m of joints that move: inertia, damping
_CLOSES = 0.03  # rad/s, from which on friction's direction is known: more than a unit of velocity
_LOAD = 0.05  # N·m, standard deviation of what may load an object before it is gripped
_BALANCE_ERROR = 0.05  # of the tips' forces, and …
_RUBBED = 0.4  # … N that a table may take off one of them, …
_RUBBED_TIME = 0.1  # … for so long [s]
_OWN = 0.8  # of the other sensor's bias: a part of it shows in both
_OFF = 5.0  # standard deviations of a drift that is named, …
_OFF_D, OFF_ANGLE = 0.1, 0.06  # … and of d, rad at least


@inner_kernel
def _between(first: float, last: float, fraction: float) -> float:
    return first + fraction * (last - first)


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
def _set_angle_slopes(h: HandFilter, finger: int, sense: float, turning: float) -> None:
    h.slopes[ANGLE] = 1.0
    h.slopes[TAPER] = 0.5 * sense
    h.slopes[SHIFT + finger] = 1.0
    h.slopes[ENCODER + finger] = -sense
    h.slopes[LATENCY] = -turning


@inner_kernel
def _set_d_slopes(h: HandFilter, finger: int, slope: float, deepening: float) -> None:
    h.slopes[D + finger] = slope
    h.slopes[LATENCY] = -slope * deepening


@kernel
def update(
    hands: Records[HandFilter],
    history: Records[Past],
    finger: int,
    t: float,
    found: tuple[float, float, float, float, float],
    covariance: FloatArray,
    systematic: FloatArray,
    table: FloatArray,
) -> bool:
    """Correct by one finger's frame of time ``t``: d, θ, tilt_y, gain, shear and their covariance.

    ``systematic`` is the part of it that all frames share: it is no reason to wait for more.
    Returns False for a frame that is refused, since what it shows can't be.
    """
    h = hands[0]
    tip = h.tip[finger]
    other = h.tip[1 - finger]
    d, theta, tilt_y, gain, shear = found
    known = 0.0
    for state in range(STATES):
        known += abs(h.mean[state]) + h.covariance[state, state]
    if not known < math.inf:  # begin anew
        tip.in_contact = other.in_contact = False
        h.grasp.unexplained_rotation[:] = 0.0
    noise = covariance[0, 0] - systematic[0, 0]
    theta_noise = covariance[1, 1] - systematic[1, 1]
    scanned = t - h.mean[LATENCY]
    row, later, fraction = _rows_at(history, h.newest, scanned)
    before = history[row]
    after = history[later]
    # The slope by latency is that over its standard deviation: joints may have stopped since.
    span = max(math.sqrt(max(h.covariance[LATENCY, LATENCY], 0.0)), _RATE_TIME)
    row, later, early = _rows_at(history, h.newest, scanned - span)
    early1 = history[row]
    early2 = history[later]
    latest = min(scanned + span, h.t)
    row, later, late = _rows_at(history, h.newest, latest)
    late1 = history[row]
    late2 = history[later]
    span = max(latest - (scanned - span), _RATE_TIME)
    sense = -1.0 if finger == 0 else 1.0
    d_since = tip.travelled[0] - _between(before.d[finger], after.d[finger], fraction)
    deepening = _between(late1.d[finger], late2.d[finger], late)
    deepening = (deepening - _between(early1.d[finger], early2.d[finger], early)) / span
    q_since = tip.travelled[1] - _between(before.q[finger], after.q[finger], fraction)
    angle_since = h.turned - _between(before.angle, after.angle, fraction)
    turning = _between(late1.angle, late2.angle, late)
    turning -= _between(early1.angle, early2.angle, early)
    closing = _between(late1.q[finger], late2.q[finger], late)
    closing -= _between(early1.q[finger], early2.q[finger], early)
    turning = (turning - sense * closing) / span
    # What may be the velocities' own steps tells nothing of the latency.
    if abs(deepening) < h.velocity_unit * h.length:
        deepening = 0.0
    if abs(turning) < 2.0 * h.velocity_unit:
        turning = 0.0
    angle = theta + sense * (tip.q - q_since)  # of the face, as this frame shows it
    spread = _between(before.spread[finger], after.spread[finger], fraction) / (d * d)
    firmness = _between(before.firmness[finger], after.firmness[finger], fraction)
    free = covariance[3, 3] > 0.0
    product = not (free or h.gain_known)
    tilt = total_tilt(theta, tilt_y)
    shown, _, stiffness, _, _, _, _ = lookup(table, d, tilt)
    steepness = stiffness / shown  # of ln F by d
    if free:
        gain /= firmness * (1.0 - _FLATTER * min(spread, _SPREAD_MAX))
        d /= 1.0 + _WIDER * min(spread, _SPREAD_MAX)
    elif h.gain_known:
        d -= math.log(firmness) / steepness
    if not tip.in_contact:
        tip.touched = h.t
    follows = h.t - tip.touched < _FOLLOWED * h.response
    begins = not tip.in_contact
    if begins:
        _begin_contact(h, finger, sense, angle + angle_since)
    if begins or follows:
        # Cells that still follow the touch show motion of before it, which no history has.
        forget(h, D + finger, d + d_since, (_UNKNOWN_D * d) ** 2)
    then = h.mean[D + finger] - d_since
    expected = h.mean[ANGLE] + 0.5 * sense * h.mean[TAPER] + h.mean[SHIFT + finger] - angle_since
    angle_off = angle - expected
    d_off = d - (then + h.mean[DRIFT + finger])
    held = tip.in_contact and other.in_contact and not follows
    if held and min(h.grasp.normal[0], h.grasp.normal[1]) > _FIRM:
        _set_angle_slopes(h, finger, sense, turning)
        angle_variance = expected_variance(h) + theta_noise
        h.slopes[:] = 0.0
        _set_d_slopes(h, finger, 1.0, deepening)
        h.slopes[DRIFT + finger] = 1.0
        d_variance = expected_variance(h) + noise
        h.slopes[:] = 0.0
        speed = abs(tip.speed) + abs(other.speed)
        jump = d_off if free else 0.0
        if _refuses(h.grasp, finger, angle_off, angle_variance, jump, d_variance, speed):
            return False
    tip.tilt_y = tilt_y
    tip.product = product
    tip.shear = shear
    tip.shared[0] = systematic[0, 0]
    tip.shared[1] = systematic[1, 1]
    if product:  # the gain's part is estimated
        of_gain = h.prior[GAIN + finger] ** 0.5 / steepness
        tip.shared[0] = max(systematic[0, 0] - of_gain * of_gain, 0.0)
    tip.fresh = not follows
    _take_angle(h, finger, sense, angle_off, theta_noise, turning, begins)
    tip.in_contact = True
    if product:
        now, _, stiffness, _, _, _, _ = lookup(table, max(then, _D_MIN), tilt)
        kept = 0.0 if begins else _STEEP_KEPT
        tip.steepness = _between(stiffness / now, tip.steepness, kept)
        off = math.log(shown / (firmness * now)) - h.mean[MODULUS + finger] - h.mean[GAIN + finger]
        _set_d_slopes(h, finger, tip.steepness, deepening)
        h.slopes[MODULUS + finger] = h.slopes[GAIN + finger] = 1.0
        _take_footprint(h, finger, off, noise * steepness * steepness)
    else:
        _set_d_slopes(h, finger, 1.0, deepening)
        h.slopes[DRIFT + finger] = 1.0
        _take_footprint(h, finger, d_off, noise)
    if free and not h.gain_known:
        height = math.log(min(max(gain, _HEIGHTS[0]), _HEIGHTS[1]))
        # What noise makes too deep it makes too flat: the footprint has told that part.
        shared = (covariance[0, 3] - systematic[0, 3]) / (noise * gain)
        own = (covariance[3, 3] - systematic[3, 3]) / (gain * gain) - shared * shared * noise
        _set_d_slopes(h, finger, -shared, deepening)
        h.slopes[DRIFT + finger] = -shared
        h.slopes[MODULUS + finger] = h.slopes[GAIN + finger] = 1.0
        off = height - h.mean[MODULUS + finger] - h.mean[GAIN + finger]
        off -= shared * (d - (h.mean[D + finger] - d_since + h.mean[DRIFT + finger]))
        correct(h, off, max(own, 0.0) + _HEIGHT_ERROR * _HEIGHT_ERROR, _GATE)
    h.mean[D + finger] = max(h.mean[D + finger], _D_MIN)
    return True


@inner_kernel
def _begin_contact(h: HandFilter, finger: int, sense: float, face: float) -> None:
    """Begin a contact of one tip, whose first frame shows its ``face`` at such an angle [rad]."""
    other = h.tip[1 - finger]
    for state in range(MODULUS + finger, FRICTION, 2):
        if state < ANGLE:
            forget(h, state, h.expected[state], h.prior[state])
    forget(h, DRIFT + finger, 0.0, 0.0)
    forget(h, SHIFT + finger, 0.0, 0.0)
    h.grasp.refused[:] = 0.0
    h.tip[finger].off = 0.0
    if other.in_contact:
        return
    begin(h)
    forget(h, ANGLE, face - 0.5 * sense * h.mean[TAPER], _UNKNOWN_ANGLE * _UNKNOWN_ANGLE)
    for k in range(2):
        shown = h.grasp.free_torque[k]
        if shown > 0.0:
            h.mean[FRICTION] += 0.5 * (shown - h.expected[FRICTION])
            h.covariance[FRICTION, FRICTION] *= 0.5
    h.covariance[FRICTION, FRICTION] += _LOAD * _LOAD


@inner_kernel
def _take_angle(
    h: HandFilter,
    finger: int,
    sense: float,
    off: float,
    noise: float,
    turning: float,
    begins: bool,
) -> None:
    before = h.mean[ANGLE] + h.mean[SHIFT + finger]
    _set_angle_slopes(h, finger, sense, turning)
    expected = expected_variance(h)
    if off * off > _GATE * _GATE * (expected + noise):  # the object turned
        h.covariance[ANGLE, ANGLE] += off * off
    correct(h, off, noise, math.inf)
    if not begins:
        turned = h.mean[ANGLE] + h.mean[SHIFT + finger] - before
        h.grasp.unexplained_rotation[finger] += turned


@inner_kernel
def _take_footprint(h: HandFilter, finger: int, off: float, noise: float) -> None:
    """Correct by what a frame shows of d, of which the slopes are set."""
    expected = expected_variance(h)
    here = off / h.slopes[D + finger]
    other = h.tip[1 - finger].off
    h.tip[finger].off = here
    # What one tip gains and the other loses, an object does that moves to one side.
    if off * off > _GATE * _GATE * (expected + noise):
        if here * other < 0.0:
            moved = min(here * here, other * other)
            for i in range(2):
                for j in range(2):
                    h.covariance[D + i, D + j] += moved if i == j else -moved
        elif h.tip[finger].product:
            h.covariance[GAIN + finger, GAIN + finger] += off * off
    correct(h, off, noise, _GATE)


@inner_kernel
def _refuses(
    grasp: GraspState,
    finger: int,
    angle: float,
    variance: float,
    deeper: float,
    deeper_variance: float,
    speed: float,
) -> bool:
    """Return whether a frame is to be refused for what it is off its prediction.

    What a frame shows of the object's angle, beyond what rolling predicts, comes in one frame of
    one tip alone where its image jumps, or of both while the joints stand still. A turn that is
    real shows in both tips, and turns the joints. So does d, where the joints stand still: an
    object that is struck is pressed into one tip as it leaves the other. ``angle`` [rad] and
    ``deeper`` [m]: what the frame is off, with the variances; ``speed`` [rad/s]: of both joints
    together. The first frame of what is real is refused as well: what the other tip shows is not
    known yet.
    """
    other = grasp.angle_off[1 - finger]
    before = grasp.angle_off[finger]
    grasp.angle_off[finger] = angle
    grasp.d_off[finger] = deeper
    turned = abs(angle) > max(JUMP, _SURE * math.sqrt(variance))
    moved = abs(deeper) > max(DEEPER, _SURE * math.sqrt(deeper_variance))
    if moved:
        moved = speed < _TURNING and abs(grasp.d_off[1 - finger]) < _ALIKE * abs(deeper)
    if turned:
        again = grasp.refused[finger] > 0.0 and abs(angle - before) > _GOES_ON
        goes_on = speed > _TURNING or again
        alike = angle * other > _ALIKE * angle * angle
        turned = not (alike and goes_on)
    if grasp.refused[finger] >= _GIVE_UP or not (turned or moved):
        grasp.refused[finger] = 0.0
        return False
    grasp.refused[finger] += 1.0
    return True


# --- torques --------------------------------------------------------------------------------------


@inner_kernel
def _steepness(h: HandFilter, finger: int) -> float:
    """Return ∂ ln F/∂d [1/m] of a tip.

    If frames show only a product of force and gain, this is the slope that the footprint uses too,
    low-pass filtered: different slopes would make unobservable directions look observed.
    """
    tip = h.tip[finger]
    if tip.product:
        steep: float = tip.steepness
        return steep
    steep = h.grasp.stiffness[finger] / max(h.grasp.force[finger], 1e-3)
    return steep


@inner_kernel
def _set_torque_slopes(h: HandFilter) -> float:
    """Set the slopes of both joints' mean torque by what scales it; return it [N·m]."""
    grasp = h.grasp
    expected = 0.0
    for k in range(2):
        scale = 1.0 + h.mean[TORQUE + k]
        moment = h.tip[k].torque / scale - grasp.torque_residual[k]
        expected += 0.5 * scale * moment
        h.slopes[TORQUE + k] = 0.5 * moment
        h.slopes[MODULUS + k] = 0.5 * scale * moment
        h.slopes[D + k] = 0.5 * scale * moment * _steepness(h, k)
    return expected


@inner_kernel
def _take_torques(h: HandFilter, dt: float) -> None:
    """Compare the joints' torques with the tips' forces, and these with each other."""
    grasp = h.grasp
    given = 0.5 * (h.tip[0].torque + h.tip[1].torque)
    h.most = max(h.most, given)
    off = given - h.mean[FRICTION] - _set_torque_slopes(h)
    if h.closing > _CLOSES:
        off -= h.inertia * (h.closing - h.opening) / dt
        h.slopes[FRICTION] = 1.0
        # Where torques have gone back, the gears hold something between nothing and all of it.
        held = min(h.most - given, h.held * given)
        correct(h, off, _TORQUE_NOISE * _TORQUE_NOISE + held * held, _GATE)
    h.slopes[:] = 0.0
    least = min(grasp.normal[0], grasp.normal[1])
    if least > 0.0 and h.t > h.compared:
        for k in range(2):
            sense = 1.0 - 2.0 * k
            h.slopes[MODULUS + k] = sense
            h.slopes[D + k] = sense * _steepness(h, k)
        error = _BALANCE_ERROR + _RUBBED / least
        noise = error * error * max(_RUBBED_TIME / (h.t - h.compared), 1.0)
        correct(h, math.log(grasp.normal[1] / grasp.normal[0]), noise, _GATE)
    h.compared = h.t


# --- results --------------------------------------------------------------------------------------


@inner_kernel
def _law_error(tip: TrackedTip, fraction: float) -> float:
    """Relative error of F by table and law; ``fraction`` is d over the tip's radius."""
    t = min(max(fraction, 0.0), 1.0) * (LAW_POINTS - 1.001)
    k = int(t)
    error: float = tip.law[k] + (t - k) * (tip.law[k + 1] - tip.law[k])
    return error


@inner_kernel
def _write_tip(h: HandFilter, finger: int, theta: float, table: FloatArray) -> Tip:
    tip = h.tip[finger]
    grasp = h.grasp
    tilt = total_tilt(theta, tip.tilt_y)
    depth = h.mean[D + finger]
    force, energy, stiffness, by_tilt, _, _, inside = lookup(table, depth, tilt)
    grasp.q[finger] = tip.q
    grasp.d[finger] = max(depth, 0.0)
    modulus = math.exp(h.mean[MODULUS + finger]) * tip.firmness
    grasp.force[finger] = modulus * force
    grasp.stiffness[finger] = modulus * stiffness
    h.slopes[D + finger] = modulus * stiffness
    h.slopes[MODULUS + finger] = grasp.force[finger]
    by_state = expected_variance(h)
    h.slopes[:] = 0.0
    sense = -1.0 if finger == 0 else 1.0
    h.slopes[ANGLE] = 1.0
    h.slopes[TAPER] = 0.5 * sense
    theta_variance = expected_variance(h) + tip.shared[1]
    h.slopes[:] = 0.0
    d_variance = max(h.covariance[D + finger, D + finger], 0.0) + tip.shared[0]
    along = theta / tilt if tilt > 0.0 else 0.0
    law = _law_error(tip, depth / h.radius) * grasp.force[finger]
    by_angle = modulus * by_tilt * along
    shared = modulus * stiffness
    force_variance = by_state + shared * shared * tip.shared[0]
    force_variance += by_angle * by_angle * theta_variance + law * law
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


@kernel
def write_grasp(
    hands: Records[HandFilter], table1: FloatArray, table2: FloatArray
) -> tuple[Tip, Tip, float, float]:
    """Write what the state means into ``grasp``, and take in what its torques tell.

    Returns d, θ, force, energy, the standard deviations of d, θ and the force, and whether they are
    inside the table, for each tip; then the object's angle [rad] and width [m].
    """
    h = hands[0]
    grasp = h.grasp
    left = h.tip[0]
    right = h.tip[1]
    taper = h.mean[TAPER]
    angle = h.mean[ANGLE]
    motion = motion_of(h)
    theta1 = angle - 0.5 * taper + left.q
    theta2 = angle + 0.5 * taper - right.q
    seen1 = _write_tip(h, 0, theta1, table1)
    seen2 = _write_tip(h, 1, theta2, table2)
    dt = h.t - grasp.t
    grasp.t = h.t
    grasp.angle_std = math.sqrt(max(h.covariance[ANGLE, ANGLE], 0.0))
    grasp.taper = taper
    arm1, arm2, turn1, turn2, grasp.jacobian_slide, width, _ = motion
    grasp.moment_arm[0] = arm1
    grasp.moment_arm[1] = arm2
    grasp.jacobian_rotation[0] = turn1
    grasp.jacobian_rotation[1] = turn2
    d = h.mean[D], h.mean[D + 1]
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
    modulus1 = math.exp(h.mean[MODULUS]) * left.firmness
    modulus2 = math.exp(h.mean[MODULUS + 1]) * right.firmness
    grasp.normal[0] = modulus1 * normal1
    grasp.normal[1] = modulus2 * normal2
    rolled = (shear - out_of_grip, shear + out_of_grip)
    torque1 = left.torque / (1.0 + h.mean[TORQUE])
    torque2 = right.torque / (1.0 + h.mean[TORQUE + 1])
    torques = torque1 / modulus1, torque2 / modulus2
    remaining1, remaining2, grasp.load_arm, curvature = load_torques(
        table1, table2, d, theta, taper, motion, rolled, torques
    )
    grasp.torque_residual[0] = modulus1 * remaining1
    grasp.torque_residual[1] = modulus2 * remaining2
    grasp.load_curvature = 2.0 * curvature / (modulus1 + modulus2)
    # A pull's forces on the two faces are opposite, a twist's alike; both must show them.
    both = math.copysign(min(abs(left.shear), abs(right.shear)), left.shear)
    grasp.sheared = both if left.shear * right.shear < 0.0 else 0.0
    grasp.twisted = both - grasp.sheared
    _set_torque_slopes(h)
    grasp.torque_std = math.sqrt(expected_variance(h))
    h.slopes[:] = 0.0
    if (left.fresh or right.fresh) and left.in_contact and right.in_contact:
        left.fresh = right.fresh = False
        if grasp.load_arm > 0.0 and dt > 0.0:
            _take_torques(h, dt)
    _judge(h)
    return seen1, seen2, angle, width


@inner_kernel
def _judge(h: HandFilter) -> None:
    """Write what speaks against a channel."""
    grasp = h.grasp
    doubted = False
    for k in range(2):
        grasp.drift[k] = h.mean[DRIFT + k]
        grasp.drift_std[k] = math.sqrt(max(h.covariance[DRIFT + k, DRIFT + k], 0.0))
        grasp.shift[k] = h.mean[SHIFT + k]
        grasp.shift_std[k] = math.sqrt(max(h.covariance[SHIFT + k, SHIFT + k], 0.0))
        grasp.gain_off[k] = h.mean[GAIN + k] - h.expected[GAIN + k]
        grasp.gain_std[k] = math.sqrt(max(h.covariance[GAIN + k, GAIN + k], 0.0))
        doubted = doubted or grasp.refused[k] > JUMPS_MAX or grasp.off_goal[k] > CURRENT_TIME
        grasp.drifted[k] = 1.0 if _has_drifted(grasp, k) else 0.0
        doubted = doubted or grasp.drifted[k] > 0.0
    grasp.doubted = doubted


@inner_kernel
def _has_drifted(grasp: GraspState, finger: int) -> bool:
    """Return whether a sensor's zero or image has moved by more than its frames may be off."""
    if not (grasp.drift_std[finger] > 0.0 and grasp.d[finger] > 0.0):
        return False
    by_d: bool = abs(grasp.drift[finger]) > max(
        _OFF_D * grasp.d[finger],
        _OFF * grasp.drift_std[finger],
        _OWN * abs(grasp.drift[1 - finger]),
    )
    by_angle = abs(grasp.shift[finger]) > max(
        OFF_ANGLE, _OFF * grasp.shift_std[finger], _OWN * abs(grasp.shift[1 - finger])
    )
    return by_d or by_angle
