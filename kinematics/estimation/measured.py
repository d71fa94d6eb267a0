"""Frame → contact by a measured law: force from the sum, tilt from the centroid, d from the force.

Needs no model of the pressure under the tip, and takes a microsecond or two.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.tip_curves import POWERS, SQUARES
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.frame_pipeline import ABOVE_MOST, ABOVE_PEAK
from softfinger.kinematics.estimation.invalid import REASONS, Invalid
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_TOUCHED = 5.0  # standard deviations of the sum, from which something touches
_BEYOND = 1.02  # of the measured depth and tilt, to which the curves are followed
_EXTENT = 0.08  # relative, by which a contact's extent may be off what its force says
_TURNS = 20  # of the iteration between d and θ
_NEAR = 1e-7  # of its range, where it ends

Curves = Annotated[FloatArray, POWERS, SQUARES]
Sums = Annotated[FloatArray, 4]
Covariance = Annotated[FloatArray, 4, 4]
Matrix = Annotated[FloatArray, 3, 3]
Three = tuple[float, float, float]


class MeasuredFit(Record):
    """A measured law, one frame's sums, and what they say."""

    radius: float
    root: float  # largest t
    slope: float  # largest sin θ
    shown: Curves
    lever: Curves
    extent: Curves
    rest: Sums
    noise: Covariance  # of the sums
    shift: Sums  # the sums of all cells' common error, one standard deviation
    zero_moment: float  # of a slope of the cells' zeros [N·m], likewise
    gain: float  # relative, of all cells alike, one standard deviation
    rotation_error: float  # of the sensor since the curves were measured [rad], likewise
    place: float  # of the tip's place since then [m], likewise
    force_error: float
    lever_error: float
    sums: Sums
    peak: float
    d: float
    n_x: float
    n_y: float
    covariance: Matrix  # of (d, n_x, n_y)
    jacobian: Matrix  # ∂(d, along, across)/∂sums
    systematic: Matrix  # the part of it that all frames share
    rotation: Matrix  # from (·, x, y) to (·, along, across)
    random: Matrix  # errors of the sums along these, from frame to frame
    shared: Matrix  # and those that all frames share
    errors: Matrix
    half: Matrix
    along: Annotated[FloatArray, 3]
    contact: bool
    invalid: int  # an `Invalid`


def sum_weights(
    grid: SensorGrid,
    radius: float,
    active: NDArray[np.bool_],
) -> FloatArray:
    """Return the weights of a frame's sums [4, cells]: area, area times x, y and r².

    Over the ``active`` cells under the tip; x and y are along the finger's axes.
    """
    x, y = (
        pitch * (np.arange(count) - 0.5 * (count - 1)) - at
        for pitch, count, at in zip(grid.pitches, grid.shape[::-1], grid.centre, strict=True)
    )
    c, s = math.cos(grid.rotation), math.sin(grid.rotation)
    along, across = c * x - s * y[:, None], s * x + c * y[:, None]
    square = along**2 + across**2
    area = math.prod(grid.pitches) * (active & (square < (radius + max(grid.pitches)) ** 2))
    return np.stack([(area * each).ravel() for each in (1.0, along, across, square)])


@inner_kernel
def _curve(c: FloatArray, t: float, q: float) -> Three:
    """A curve's value and partials."""
    value = by_t = by_q = 0.0
    for k in range(POWERS):
        i = POWERS - 1 - k
        row = c[i, 0] + q * (c[i, 1] + q * c[i, 2])
        by_t = by_t * t + value
        value = value * t + row
        by_q = by_q * t + c[i, 1] + 2.0 * q * c[i, 2]
    return value, by_t, by_q


@inner_kernel
def _root_of(fit: MeasuredFit, force: float, q: float, t: float) -> float:
    """t at which ``shown``, which rises, is ``force``: Newton's iteration from ``t``."""
    for _ in range(24):
        value, by_t, _ = _curve(fit.shown, t, q)
        before = t
        t = min(max(t - (value - force) / by_t, 0.3 * t), _BEYOND * fit.root)
        if abs(t - before) < _NEAR * fit.root:
            break
    return t


@kernel
def fit_measured_frame(
    fits: Records[MeasuredFit], frame: FloatArray, weights: FloatArray, scale: float
) -> None:
    """Estimate one frame [rows, cols] into the record; ``scale`` Pa a unit."""
    fit = fits[0]
    fit.peak = 0.0
    fit.sums[:] = 0.0
    cols = frame.shape[1]
    for i in range(frame.shape[0]):
        for j in range(cols):
            reading = frame[i, j] * scale
            k = i * cols + j
            for m in range(4):
                fit.sums[m] += weights[m, k] * reading
            fit.peak = max(fit.peak, reading if weights[0, k] > 0.0 else 0.0)
    for m in range(4):
        fit.sums[m] -= fit.rest[m]
    fit.d = fit.n_x = fit.n_y = 0.0
    fit.covariance[:] = 0.0
    fit.systematic[:] = 0.0
    force = fit.sums[0]
    finite = math.isfinite(force) and math.isfinite(fit.peak)
    std = math.sqrt(fit.noise[0, 0] + fit.shift[0] ** 2)
    fit.contact = finite and force > _TOUCHED * std
    reason = Invalid.NONE if finite else Invalid.NOT_FINITE
    if not fit.contact:
        # What could hide: the d whose force is only just felt.
        t = _root_of(fit, _TOUCHED * std, 0.0, fit.root)
        fit.covariance[0, 0] = fit.systematic[0, 0] = (fit.radius * t * t) ** 2
    else:
        reason = _contact(fit)
        if reason != Invalid.NONE and _all_above(fit, frame, weights, scale):
            reason = Invalid.ABOVE_ZERO
    fit.invalid = reason


@inner_kernel
def _all_above(fit: MeasuredFit, frame: FloatArray, weights: FloatArray, scale: float) -> bool:
    """Return whether about all cells under the tip read as they do where nothing was tared."""
    above = number = 0
    for i in range(frame.shape[0]):
        for j in range(frame.shape[1]):
            if weights[0, i * frame.shape[1] + j] > 0.0:
                number += 1
                above += frame[i, j] * scale > ABOVE_PEAK * fit.peak
    return above > ABOVE_MOST * number


@inner_kernel
def _contact(fit: MeasuredFit) -> Invalid:
    """Set the contact that the sums say; check that the curves hold and its extent agrees."""
    force = fit.sums[0]
    moment = math.hypot(fit.sums[1], fit.sums[2])
    s_max = _BEYOND * fit.slope
    s = target = step = 0.0
    t = _root_of(fit, force, 0.0, fit.root)
    for _ in range(_TURNS):
        lever = max(_curve(fit.lever, t, s * s)[0], 1e-9 * fit.radius)
        target = moment / (force * lever)
        before = step
        step = min(target, s_max) - s
        if step * before < 0.0:
            step *= 0.5
        s += step
        t = _root_of(fit, force, s * s, t)
        if abs(step) < _NEAR:
            break
    c_x = fit.sums[1] / moment if moment > 0.0 else 1.0
    c_y = fit.sums[2] / moment if moment > 0.0 else 0.0
    std = _set_covariance(fit, t, s, c_x, c_y)
    s *= 1.0 - std * std / (std * std + fit.slope * fit.slope)
    t = _root_of(fit, force, s * s, t)
    q = s * s
    fit.d = fit.radius * t * t
    fit.n_x = s * c_x
    fit.n_y = s * c_y
    extent = _curve(fit.extent, t, q)[0]
    # The sums' r² is 0.08 of itself off, or by its noise, where something else presses.
    off = abs(fit.sums[3] - force * extent)
    agrees = off < _EXTENT * force * extent + _TOUCHED * math.sqrt(fit.noise[3, 3])
    within = t < _BEYOND * fit.root * (1.0 - 1e-9) and target < s_max + 3.0 * std
    if not within:
        return Invalid.BEYOND
    return Invalid.NONE if agrees else Invalid.MODEL


@inner_kernel
def _set_covariance(fit: MeasuredFit, t: float, s: float, c_x: float, c_y: float) -> float:
    """Set the covariance; returns the standard deviation of sin θ by the sums alone.

    In axes along the tilt and across: the sum's errors and both moments', through the partials. A
    tilt that the centroid hardly shows is more likely one of those that were measured, some
    ``slope``: it is drawn to 0 as a Kalman filter would, which all frames share.
    """
    q = s * s
    shown, shown_t, shown_q = _curve(fit.shown, t, q)
    lever, lever_t, lever_q = _curve(fit.lever, t, q)
    per_d = 1.0 / (2.0 * fit.radius * t)  # dt/dd
    # Partials of (sum, moment along) by (d, s); of the moment across by the turn across.
    a = shown_t * per_d
    b = 2.0 * s * shown_q
    c = s * (a * lever + shown * lever_t * per_d)
    e = shown * lever + s * (b * lever + shown * 2.0 * s * lever_q)
    across = shown * lever
    inverse = 1.0 / (a * e - b * c)
    fit.jacobian[0, 0] = e * inverse
    fit.jacobian[0, 1] = -b * inverse
    fit.jacobian[1, 0] = -c * inverse
    fit.jacobian[1, 1] = a * inverse
    fit.jacobian[2, 2] = 1.0 / across
    fit.rotation[0, 0] = 1.0
    fit.rotation[1, 1] = fit.rotation[2, 2] = c_x
    fit.rotation[1, 2] = c_y
    fit.rotation[2, 1] = -c_y
    _between(fit, fit.rotation, fit.noise, fit.random)
    for i in range(3):
        shift = fit.rotation[i, 0] * fit.shift[0] + fit.rotation[i, 1] * fit.shift[1]
        fit.along[i] = shift + fit.rotation[i, 2] * fit.shift[2]
    placed = math.hypot(fit.lever_error, fit.place)
    missed = fit.force_error, placed, math.hypot(placed, fit.rotation_error * lever * s)
    grown = fit.gain * shown, fit.gain * shown * lever * s, 0.0
    for i in range(3):
        for j in range(3):
            fit.shared[i, j] = fit.along[i] * fit.along[j] + grown[i] * grown[j]
        fit.shared[i, i] += (missed[i] * shown) ** 2 + (fit.zero_moment**2 if i > 0 else 0.0)
    fit.errors[:] = fit.random + fit.shared
    _between(fit, fit.jacobian, fit.errors, fit.covariance)
    variance = fit.covariance[1, 1]
    prior = fit.slope * fit.slope
    drawn_d = fit.covariance[0, 1] / (variance + prior)
    drawn = variance / (variance + prior)
    aside = fit.covariance[2, 2] / (fit.covariance[2, 2] + prior)
    for j in range(3):
        fit.jacobian[0, j] -= drawn_d * fit.jacobian[1, j]
        fit.jacobian[1, j] *= 1.0 - drawn
        fit.jacobian[2, j] *= 1.0 - aside
    _between(fit, fit.jacobian, fit.errors, fit.covariance)
    _between(fit, fit.jacobian, fit.shared, fit.systematic)
    for out in (fit.covariance, fit.systematic):
        out[0, 0] += prior * drawn_d * drawn_d
        out[0, 1] += prior * drawn_d * drawn
        out[1, 0] += prior * drawn_d * drawn
        out[1, 1] += prior * drawn * drawn
        out[2, 2] += prior * aside * aside
    fit.rotation[1, 2] = -c_y  # and back
    fit.rotation[2, 1] = c_y
    for out in (fit.covariance, fit.systematic):
        fit.errors[:] = out
        _between(fit, fit.rotation, fit.errors, out)
    return math.sqrt(variance)


@inner_kernel
def _between(fit: MeasuredFit, a: FloatArray, m: FloatArray, out: FloatArray) -> None:
    """``out`` = a m aᵀ, 3 × 3."""
    for i in range(3):
        for j in range(3):
            fit.half[i, j] = a[i, 0] * m[0, j] + a[i, 1] * m[1, j] + a[i, 2] * m[2, j]
    for i in range(3):
        for j in range(3):
            out[i, j] = (
                fit.half[i, 0] * a[j, 0] + fit.half[i, 1] * a[j, 1] + fit.half[i, 2] * a[j, 2]
            )


class MeasuredEstimator:
    """`ContactEstimator` for a tip whose ``physics`` is "measured". Each frame stands alone.

    ``grid`` has the tip where the law found it. ``active`` [rows, cols] bool masks dead cells;
    ``known`` are the sensor's other uncertainties: baseline, slope, and gain, centre and rotation
    since the curves were measured. An estimate is ``valid`` where the curves were
    measured, and where the frame's extent is within 8 % of what its force says. Raises ValueError
    for arguments out of their range.
    """

    saturation: float | None = None  # a full cell counts as it reads

    def __init__(
        self,
        tip: Fingertip,
        grid: SensorGrid,
        active: NDArray[np.bool_] | None = None,
        known: Uncertainty | None = None,
    ) -> None:
        law = tip.law
        if law is None or law.radius != tip.radius:
            raise ValueError(f"expected a tip measured at its radius {tip.radius:g} m")
        alive = np.ones(grid.shape, np.bool_) if active is None else active
        self.grid = grid
        self._weights = sum_weights(grid, tip.radius, alive)
        fit = self._fit = MeasuredFit()
        fit.radius, fit.root, fit.slope = tip.radius, law.root, math.sin(law.tilt)
        fit.force_error, fit.lever_error = law.force_error, law.lever_error
        for name in ("shown", "lever", "extent", "rest", "noise"):
            setattr(fit, name, np.array(getattr(law, name)))
        if known is not None:
            fit.shift = known.baseline * self._weights.sum(axis=1)
            fit.zero_moment = known.slope / tip.radius * 0.5 * self._weights[3].sum()
            fit.gain, fit.rotation_error, fit.place = known.gain, known.rotation, known.centre
        self._frame = np.zeros(grid.shape)
        self._seq: int | None = None
        self._last = ContactEstimate()

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """A new result; frames as for :meth:`update`."""
        before, self._last = self._last, ContactEstimate()
        try:
            return self.update(frame, pascal_per_count)
        finally:
            self._last = before

    def update(
        self, frame: NDArray[Any], pascal_per_count: float = 1.0, seq: int | None = None
    ) -> ContactEstimate:
        """Return the one result object, from a frame [rows, cols] of any number type.

        Its values times ``pascal_per_count`` are Pa. Raises ValueError for another shape.
        """
        result, fit = self._last, self._fit
        if seq is not None and seq == self._seq:
            return result
        if frame.shape != self._frame.shape:
            raise ValueError(f"a frame must have shape {self._frame.shape}, got {frame.shape}")
        np.copyto(self._frame, frame)
        fit_measured_frame(fit.array, self._frame, self._weights, float(pascal_per_count))
        result.contact, result.invalid = fit.contact, REASONS[fit.invalid]
        result.peak, result.d = fit.peak, fit.d
        result.tilt_x, result.tilt_y = math.asin(fit.n_x), math.asin(fit.n_y)
        per_tilt = np.array([1.0, 1.0 / math.cos(result.tilt_x), 1.0 / math.cos(result.tilt_y)])
        per_tilts = per_tilt * per_tilt[:, None]
        result.covariance[:3, :3] = fit.covariance * per_tilts
        result.systematic[:3, :3] = fit.systematic * per_tilts
        self._seq = seq
        return result

    def reset(self) -> None:
        """Forget the last frame's number."""
        self._seq = None
