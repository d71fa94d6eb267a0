"""Frame → contact by a measured law: force from the sum, tilt from the centroid, d from the force.

Needs no model of the pressure under the tip, and takes a tenth of a millisecond.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.tip_curves import Curve
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.frame_pipeline import ABOVE_MOST, ABOVE_PEAK
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.sensing.footprint import FloatArray
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_TOUCHED = 5.0  # standard deviations of the sum, from which something touches
_BEYOND = 1.02  # of the measured depth and tilt, to which the curves are followed
_EXTENT = 0.08  # relative, by which a contact's extent may be off what its force says
_TURNS = 20  # of the iteration between d and θ
_NEAR = 1e-7  # of its range, where it ends


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


def _curve(curve: Curve, t: float, q: float) -> tuple[float, float, float]:
    """A curve's value and partials by t and q."""
    value = by_t = by_q = 0.0
    for a, b, c in reversed(curve):
        by_t = by_t * t + value
        value = value * t + a + q * (b + q * c)
        by_q = by_q * t + b + 2.0 * q * c
    return value, by_t, by_q


class MeasuredEstimator:
    """`ContactEstimator` for a tip whose ``physics`` is "measured". Each frame stands alone.

    ``grid`` has the tip where the law found it. ``active`` [rows, cols] bool masks dead cells;
    ``known`` are the sensor's other uncertainties: baseline, slope, and gain, centre and rotation
    since the curves were measured. An estimate is ``valid`` where the curves were
    measured, and where the frame's extent is within 8 % of what its force says. Raises ValueError
    for arguments out of their range.
    """

    saturation: float | None = None  # a full cell counts as it reads

    noise = 0.0  # of a cell [Pa]: this one goes by what its tip's curves have measured

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
        self._law = law
        self._root, self._slope = law.root, math.sin(law.tilt)
        self._known = known = known or Uncertainty()
        self._weights = sum_weights(grid, tip.radius, alive)
        self._under = self._weights[0] > 0.0
        self._rest, self._noise = np.array(law.rest), np.array(law.noise)
        # The sums of all cells' common error, and the moment of a slope of their zeros [N·m].
        self._shift = known.baseline * self._weights.sum(axis=1)
        self._zero_moment = known.slope / tip.radius * 0.5 * self._weights[3].sum()
        self._felt = _TOUCHED * math.hypot(math.sqrt(self._noise[0, 0]), self._shift[0])
        # What could hide: the d whose force is only just felt.
        self._hidden = tip.radius * self._root_of(self._felt, 0.0, self._root) ** 2
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
        result = self._last
        if seq is not None and seq == self._seq:
            return result
        if frame.shape != self.grid.shape:
            raise ValueError(f"a frame must have shape {self.grid.shape}, got {frame.shape}")
        readings = float(pascal_per_count) * frame.ravel()[self._under].astype(np.float64)
        finite = bool(np.isfinite(readings).all())
        sums = self._weights[:, self._under] @ readings - self._rest
        result.peak = max(float(readings.max(initial=0.0)), 0.0) if finite else 0.0
        result.contact = finite and bool(sums[0] > self._felt)
        result.d = result.tilt_x = result.tilt_y = 0.0
        result.covariance[:] = result.systematic[:] = 0.0
        result.invalid = Invalid.NONE if finite else Invalid.NOT_FINITE
        if result.contact:
            result.invalid = self._contact(sums, result)
            # About all cells read as they do where nothing was tared.
            above = np.count_nonzero(readings > ABOVE_PEAK * result.peak)
            if result.invalid and above > ABOVE_MOST * readings.size:
                result.invalid = Invalid.ABOVE_ZERO
        else:
            result.covariance[0, 0] = result.systematic[0, 0] = self._hidden**2
        self._seq = seq
        return result

    def reset(self) -> None:
        """Forget the last frame's number."""
        self._seq = None

    def _root_of(self, force: float, q: float, t: float) -> float:
        """t at which ``shown``, which rises, is ``force``: Newton's iteration from ``t``."""
        for _ in range(24):
            value, by_t, _ = _curve(self._law.shown, t, q)
            before = t
            t = min(max(t - (value - force) / by_t, 0.3 * t), _BEYOND * self._root)
            if abs(t - before) < _NEAR * self._root:
                break
        return t

    def _contact(self, sums: FloatArray, result: ContactEstimate) -> Invalid:
        """Set the contact that the sums say; check that the curves hold and its extent agrees."""
        force, along, across, square = sums.tolist()
        moment = math.hypot(along, across)
        s_max = _BEYOND * self._slope
        s = target = step = 0.0
        t = self._root_of(force, 0.0, self._root)
        for _ in range(_TURNS):
            lever = max(_curve(self._law.lever, t, s * s)[0], 1e-9 * self._law.radius)
            target = moment / (force * lever)
            before = step
            step = min(target, s_max) - s
            if step * before < 0.0:
                step *= 0.5
            s += step
            t = self._root_of(force, s * s, t)
            if abs(step) < _NEAR:
                break
        c_x, c_y = (along / moment, across / moment) if moment > 0.0 else (1.0, 0.0)
        std, covariances = self._covariances(t, s, c_x, c_y)
        s *= 1.0 - std * std / (std * std + self._slope * self._slope)
        t = self._root_of(force, s * s, t)
        result.d = self._law.radius * t * t
        result.tilt_x, result.tilt_y = math.asin(s * c_x), math.asin(s * c_y)
        per_tilt = np.array([1.0, 1.0 / math.cos(result.tilt_x), 1.0 / math.cos(result.tilt_y)])
        for found, out in zip(covariances, (result.covariance, result.systematic), strict=True):
            out[:3, :3] = found * np.outer(per_tilt, per_tilt)
        extent = force * _curve(self._law.extent, t, s * s)[0]
        # The sums' r² is 0.08 of itself off, or by its noise, where something else presses.
        agrees = abs(square - extent) < _EXTENT * extent + _TOUCHED * math.sqrt(self._noise[3, 3])
        if not (t < _BEYOND * self._root * (1.0 - 1e-9) and target < s_max + 3.0 * std):
            return Invalid.BEYOND
        return Invalid.NONE if agrees else Invalid.MODEL

    def _covariances(
        self, t: float, s: float, c_x: float, c_y: float
    ) -> tuple[float, tuple[FloatArray, FloatArray]]:
        """Return sin θ's standard deviation by the sums alone; covariances of (d, n_x, n_y).

        Of all errors, and of those that all frames share. In axes along the tilt and across: the
        sum's errors and both moments', through the partials. A tilt that the centroid hardly shows
        is more likely one of those that were measured, some ``slope``: it is drawn to 0 as a Kalman
        filter would, which all frames share.
        """
        law, known, q = self._law, self._known, s * s
        shown, shown_t, shown_q = _curve(law.shown, t, q)
        lever, lever_t, lever_q = _curve(law.lever, t, q)
        per_d = 1.0 / (2.0 * law.radius * t)  # dt/dd
        # Partials of (sum, moment along) by (d, s); of the moment across by the turn across.
        by_d = shown_t * per_d, s * (shown_t * per_d * lever + shown * lever_t * per_d)
        b = 2.0 * s * shown_q
        by_s = b, shown * lever + s * (b * lever + shown * 2.0 * s * lever_q)
        partials = np.array(
            [[by_d[0], by_s[0], 0.0], [by_d[1], by_s[1], 0.0], [0.0, 0.0, shown * lever]]
        )
        jacobian = np.linalg.inv(partials)
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, c_x, c_y], [0.0, -c_y, c_x]])
        random = rotation @ self._noise[:3, :3] @ rotation.T
        shift = rotation @ self._shift[:3]
        grown = known.gain * shown * np.array([1.0, lever * s, 0.0])
        placed = math.hypot(law.lever_error, known.centre)
        turned = math.hypot(placed, known.rotation * lever * s)
        missed = (shown * np.array([law.force_error, placed, turned])) ** 2
        missed[1:] += self._zero_moment**2
        shared = np.outer(shift, shift) + np.outer(grown, grown) + np.diag(missed)
        errors = jacobian @ (random + shared) @ jacobian.T
        prior = self._slope * self._slope
        drawn = np.array([[errors[0, 1], 0.0], [errors[1, 1], 0.0], [0.0, errors[2, 2]]]) / (
            errors.diagonal()[1:] + prior
        )
        jacobian -= drawn @ jacobian[1:]
        towards = prior * drawn @ drawn.T
        both = (
            rotation.T @ (jacobian @ each @ jacobian.T + towards) @ rotation
            for each in (random + shared, shared)
        )
        return math.sqrt(errors[1, 1]), (next(both), next(both))
