"""Kalman filter of the force witnesses' scales: tells a stiffer tip from a sensor's gain.

A tip's normal force F is known in several ways, each off by a scale of its own:

- the footprint's shape gives d, and so the table's F₀(d, θ), without any scale of the sensor; the
  force is F = e^ε F₀ where the tip's modulus is e^ε times the settings';
- the frame's height over the model's is A = e^(ε + γ), with e^γ the gain of the sensor;
- both joints' mean torque is that of (1 + κ) e^ε M + o, with M the moment of the table's forces, κ
  the error of the torque constant, and o an offset: friction, or a load that stood before the grip;
- what both tips press is equal up to what the object rubs on.

Frames that were fitted with a fixed gain, as of a solid tip, show F e^γ: there the joints' closing
tells A, and what tells F tells γ. One frame can't tell ε from γ. A Kalman filter holds (ε, γ, κ, o)
of both fingers, with priors: a modulus is known to some 20 % before it was calibrated, a sensor's
gain changes by 5-32 % when it is mounted again (DTIC ADP011007), a torque constant is good to 10 %.
Torques, as they arrive through gears that close, are taken in only while a grip's force ramps: a
wrong scale grows with it, a load along the faces doesn't. Of those that have fallen again gears may
hold the rest. The height is taken in with each frame; what changes of it in a lasting
grip is the sensor's, for a modulus doesn't jump. What was found in a grip that came to hold, and
no witness of which was refused, stays for later ones, 5 % less with each; `softfinger calibrate
scales` keeps it.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record

FloatArray = NDArray[np.float64]

STATES = 8
MODULUS, GAIN, TORQUE, OFFSET = 0, 2, 4, 6  # indices of the left finger's; the right one's follow

MODULUS_ERROR = 0.2  # of a tip whose modulus nobody measured
GAIN_DOUBTED = 1.5  # prior standard deviations off, a sensor's gain is reported
CALIBRATED_ERROR = 0.05  # of one that `softfinger calibrate modulus` found
_LOAD_ERROR = 0.05  # N·m, standard deviation of what stands in a joint beside its friction
_GAIN_WALK = 0.05  # 1/√s, what a sensor's gain does in a grip: warmth, creep
_OFFSET_WALK = 0.05  # N·m/√s, what friction does while the force ramps
_FORGET = 0.1  # fraction of what was learnt, with each new grip
_RELOADED = 0.4  # of the way from a slow cell's gain variance to its prior, with each loading
_HEIGHT_ERROR = 0.02  # of a frame's height, by all that the model leaves out
_TORQUE_NOISE = 0.02  # N·m of a joint that stands
_MOVING_NOISE = 0.05  # N·m of one that moves: inertia, damping
_MOVING = 0.05  # rad/s
_INTERVAL_MAX = 0.1  # s
_LATENCY_ERROR = 0.01  # s, standard deviation of a frame's time that nobody measured
_BALANCE_ERROR = 0.05  # of the tips' forces, and …
_RUBBED = 0.4  # … N that a table may take off one of them
_GATE = 3.0  # standard deviations: what is further off counts as no more than so much
_TORQUE_MOST = 0.3  # fraction, beyond which no torque constant is off
_SURER = 1e-6  # least part of a variance that one measurement leaves: rounding takes none below 0
_HEIGHTS = 1e-3, 1e3  # of frames over the model's, beyond which it is no height


class Prior(NamedTuple):
    """One finger's scales as they were known before a grip: (mean, relative standard deviation)."""

    modulus: tuple[float, float] = (1.0, MODULUS_ERROR)
    gain: tuple[float, float] = (1.0, 0.25)
    torque: tuple[float, float] = (1.0, 0.1)


UNKNOWN = Prior()


class Scales(Record):
    """Scales of both fingers, logarithms of moduli, gains, torques and offsets, with covariance."""

    mean: Annotated[FloatArray, STATES]
    covariance: Annotated[FloatArray, STATES, STATES]
    expected: Annotated[FloatArray, STATES]  # means of the prior, and …
    prior: Annotated[FloatArray, STATES]  # … its variances
    friction: float  # of a joint that moves [N·m]
    inertia: float  # of a joint [kg·m²]
    held: float  # fraction of the tips' moment that gears hold while the torque goes back
    most: float  # greatest torque of the grip, of both joints' mean [N·m]
    speed: float  # of the joints' closing when torques were taken in last [rad/s]
    t: float  # and when that was [s]
    last: float  # mean moment of the tips' forces then [N·m]
    modulus: Pair  # e^ε: force over the table's
    torque: Pair  # of the joints, and …
    moment: Pair  # … of the tips' forces about them, when torques were taken in last [N·m]
    product: Pair  # 1 where frames show but e^γ times the force, d and modulus in one; 0: d
    slopes: Annotated[FloatArray, STATES]  # scratch: of a measurement by the states
    cross: Annotated[FloatArray, STATES]  # scratch
    gripping: bool  # both tips touch, and have since `begin_grip`
    kept_mean: Annotated[FloatArray, STATES]  # as they were before this touch, or as it held
    kept_covariance: Annotated[FloatArray, STATES, STATES]
    doubted: bool  # a witness has been, since something touches
    proven: bool  # it held, undoubted, and no force has been on its way since


def set_prior(
    scales: Scales,
    fingers: tuple[Prior, Prior],
    friction: float,
    inertia: float,
    held: float,
) -> None:
    """Begin with what is known of each finger; joints have ``friction`` [N·m], ``inertia``.

    Of the tips' moment gears hold the fraction ``held`` while the torque goes back.
    """
    scales.friction, scales.inertia, scales.held = friction, inertia, held
    for k, prior in enumerate(fingers):
        scales.expected[MODULUS + k] = math.log(prior.modulus[0])
        scales.expected[GAIN + k] = math.log(prior.gain[0])
        scales.expected[TORQUE + k] = prior.torque[0] - 1.0
        scales.prior[[MODULUS + k, GAIN + k, TORQUE + k]] = np.square([each[1] for each in prior])
        scales.prior[OFFSET + k] = friction**2 + _LOAD_ERROR**2
    forget(scales, 1.0)


def end_touch(scales: Scales) -> None:
    """Forget what no hold has proven: of tips that pressed each other, of a fault, of a release.

    A grip that came to no hold takes half of what was known before with it, which may be why.
    """
    scales.mean[:], scales.covariance[:] = scales.kept_mean, scales.kept_covariance
    forget(scales, 0.5 if scales.gripping and not scales.proven else 0.0)
    scales.doubted = scales.proven = scales.gripping = False


def forget(scales: Scales, fraction: float) -> None:
    """Go back towards what is set by a ``fraction``, and keep it so."""
    scales.mean += fraction * (scales.expected - scales.mean)
    scales.covariance *= 1.0 - fraction
    scales.covariance += fraction * np.diag(scales.prior)
    scales.kept_mean[:], scales.kept_covariance[:] = scales.mean, scales.covariance
    scales.modulus[:] = np.exp(scales.mean[MODULUS : MODULUS + 2])


@inner_kernel
def begin_grip(s: Scales, slow: bool) -> None:
    """Begin a new grip: offsets are unknown again, and the rest becomes a little less certain.

    Means go back towards what is set as standard deviations do. Nothing measured tells a stiffer
    tip from a smaller torque constant: without that, both would drift from grip to grip. ``slow``
    cells read low early in each ramp: with a gain still sure, that would soften the tip each time.
    """
    s.gripping = True
    for i in range(STATES):
        s.mean[i] += 0.5 * _FORGET * (s.expected[i] - s.mean[i])
        for j in range(STATES):
            if i >= OFFSET or j >= OFFSET:
                s.covariance[i, j] = 0.0
            else:
                s.covariance[i, j] *= 1.0 - _FORGET
        s.covariance[i, i] += s.prior[i] * (1.0 if i >= OFFSET else _FORGET)
        if slow and GAIN <= i < TORQUE:
            s.covariance[i, i] += _RELOADED * max(s.prior[i] - s.covariance[i, i], 0.0)
    s.mean[OFFSET] = s.mean[OFFSET + 1] = s.most = 0.0


@inner_kernel
def keep(s: Scales) -> None:
    """Keep what was learnt beyond this touch, where no witness was doubted that taught it."""
    for k in range(TORQUE, OFFSET):
        s.doubted = s.doubted or abs(s.mean[k] - s.expected[k]) >= _TORQUE_MOST
    s.proven = not s.doubted
    if s.proven:
        s.kept_mean[:] = s.mean
        s.kept_covariance[:] = s.covariance


@inner_kernel
def drift(s: Scales, dt: float) -> None:
    """Let ``dt`` s pass in a grip."""
    for k in range(2):
        s.covariance[GAIN + k, GAIN + k] += _GAIN_WALK * _GAIN_WALK * dt
        s.covariance[OFFSET + k, OFFSET + k] += _OFFSET_WALK * _OFFSET_WALK * dt


@inner_kernel
def _update(s: Scales, innovation: float, variance: float, gate: float) -> None:
    """Update by one measurement's ``innovation``, with `slopes` by the states.

    Beyond a ``gate`` [standard deviations] it weighs as if it were that far off: nobody is believed
    alone. What is not finite tells nothing. Leaves the slopes 0.
    """
    slopes = s.slopes
    cross = s.cross
    expected = 0.0
    for i in range(STATES):
        total = 0.0
        for j in range(STATES):
            total += s.covariance[i, j] * slopes[j]
        cross[i] = total
        expected += slopes[i] * total
    variance = max(variance, innovation * innovation / (gate * gate) - expected, _SURER * expected)
    if expected + variance < math.inf and abs(innovation) < math.inf:
        inverse = 1.0 / (expected + variance)
        for i in range(STATES):
            s.mean[i] += cross[i] * inverse * innovation
            for j in range(STATES):
                s.covariance[i, j] -= cross[i] * cross[j] * inverse
        for i in range(TORQUE, OFFSET):
            off = s.mean[i] - s.expected[i]
            s.mean[i] = s.expected[i] + min(max(off, -_TORQUE_MOST), _TORQUE_MOST)
    slopes[:] = 0.0


@inner_kernel
def height(s: Scales, finger: int) -> tuple[float, float]:
    """Return a finger's height over the model's that is expected, and its relative variance."""
    i = MODULUS + finger
    j = GAIN + finger
    variance = s.covariance[i, i] + s.covariance[j, j] + 2.0 * s.covariance[i, j]
    return math.exp(s.mean[i] + s.mean[j]), max(variance, _HEIGHT_ERROR * _HEIGHT_ERROR)


@inner_kernel
def update_height(s: Scales, finger: int, height: float, variance: float, known: float) -> None:
    """Update by the filtered ``height`` of a finger's frames over the model's.

    Of its inverse ``variance`` so much was ``known`` here before, and went into it.
    """
    new = 1.0 - known * variance
    if new > 0.0:
        s.slopes[MODULUS + finger] = s.slopes[GAIN + finger] = 1.0
        found = math.log(min(max(height, _HEIGHTS[0]), _HEIGHTS[1]))
        innovation = found - s.mean[MODULUS + finger] - s.mean[GAIN + finger]
        noise = variance / new + _HEIGHT_ERROR * _HEIGHT_ERROR
        _update(s, innovation / new, noise, math.inf)


@inner_kernel
def _by_force(s: Scales, finger: int, slope: float) -> None:
    """Set a measurement's slopes by what scales a tip's force, of which its ``slope`` is known."""
    s.slopes[MODULUS + finger] = (1.0 - s.product[finger]) * slope
    s.slopes[GAIN + finger] = -s.product[finger] * slope


@inner_kernel
def update_torque(s: Scales, torque: Pair, moment: Pair, speed: float, t: float) -> None:
    """Update by the joints' ``torque`` [N·m] where the tips' forces make a ``moment`` [N·m].

    The mean of both: what turns the object, shakes it or leans on it is in one as much as it lacks
    in the other. ``speed`` [rad/s]: of their closing; ``t``: the time [s].
    """
    faster = speed - s.speed
    since = t - s.t
    s.speed = speed
    s.t = t
    if not 0.0 < since < _INTERVAL_MAX:
        return
    innovation = 0.0
    slopes = s.slopes
    for k in range(2):
        scaled = 0.5 * (1.0 + s.mean[TORQUE + k]) * moment[k]
        innovation += 0.5 * torque[k] - scaled - 0.5 * s.mean[OFFSET + k]
        _by_force(s, k, scaled)
        slopes[TORQUE + k] = 0.5 * moment[k]
        slopes[OFFSET + k] = 0.5
    innovation -= s.friction * min(max(speed / _MOVING, -1.0), 1.0) + s.inertia * faster / since
    noise = _MOVING_NOISE if abs(speed) > _MOVING else _TORQUE_NOISE
    # Frames may be older than their time says: the force is that of a little before or after. Where
    # frames don't tell d, the ramp is all there is to tell their gain.
    both = 0.5 * (moment[0] + moment[1])
    late = _LATENCY_ERROR * (both - s.last) / since * (1.0 - 0.5 * (s.product[0] + s.product[1]))
    s.last = both
    # Where torques have gone back, the gears hold something between nothing and all of it.
    given = 0.5 * (torque[0] + torque[1])
    s.most = max(s.most, given)
    held = min(s.most - given, s.held * 0.5 * (moment[0] + moment[1]))
    _update(s, innovation, noise * noise + held * held + late * late, _GATE)


@inner_kernel
def update_balance(s: Scales, force1: float, force2: float) -> None:
    """Update by the balance: both tips press an object with about the same force.

    Tips that don't press, as of an object that lies askew between them, tell nothing.
    """
    if not min(force1, force2) > 0.0:
        return
    _by_force(s, 0, 1.0)
    _by_force(s, 1, -1.0)
    error = _BALANCE_ERROR + _RUBBED / min(force1, force2)
    _update(s, math.log(force2 / force1), error * error, _GATE)


@inner_kernel
def settle(s: Scales) -> None:
    """Write the moduli that follow."""
    for k in range(2):
        s.modulus[k] = math.exp(s.mean[MODULUS + k])
