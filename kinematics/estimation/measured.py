"""Estimate a contact using the measured curves of a tip.

The sum of the frame determines the force, and the force determines d. The centroid determines the
tilt. The method does not need a model of the pressure distribution and takes about 0.1 ms.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.tip_curves import Curve
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.frame_pipeline import ABOVE_FRACTION, ABOVE_PEAK
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_CONTACT_SIGMA = 5.0  # contact threshold of the sum of readings, in the sum's standard deviations
_EXTRAPOLATION_MAX = 1.02  # extrapolation limit, relative to the measured depth and tilt
_EXTENT_ERROR_MAX = 0.08  # maximum relative difference between the measured and the expected extent
_ITERATIONS_MAX = 20  # maximum number of iterations, which alternate between d and θ
_TOLERANCE = 1e-7  # convergence tolerance, relative to the range


def sum_weights(
    grid: SensorGrid,
    radius: float,
    active: NDArray[np.bool_],
) -> FloatArray:
    """Return the weights [4, cells] of the cells in the four frame sums.

    The weights are the cell area, and the area times x, y and r². Cells that are not ``active`` or
    not under the tip have zero weights. The x and y axes are the finger axes.
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
    """Return the value of a curve and its partials with respect to t and q."""
    value = by_t = by_q = 0.0
    for a, b, c in reversed(curve):
        by_t = by_t * t + value
        value = value * t + a + q * (b + q * c)
        by_q = by_q * t + b + 2.0 * q * c
    return value, by_t, by_q


class MeasuredEstimator:
    """Contact estimator for a tip whose ``physics`` is "measured".

    Each frame is processed independently of the other frames.

    Parameters
    ----------
    tip
        Measured tip.
    grid
        Sensor; its tip position must come from the measured curves.
    active
        Mask of working cells, bool [rows, cols]; None uses all cells.
    known
        Sensor uncertainties. For gain, centre and rotation, only changes after the curves were
        measured count.

    Raises
    ------
    ValueError
        If an argument is out of range.

    Notes
    -----
    A ``valid`` estimate is within the measured range of the curves. The frame's extent differs by
    less than 8 % from the value expected for the force.
    """

    saturation: float | None = None  # Saturated cells are treated like all other cells.

    noise = 0.0  # not used, because the curves already include the measured noise

    def __init__(
        self,
        tip: Fingertip,
        grid: SensorGrid,
        active: NDArray[np.bool_] | None = None,
        known: Uncertainty | None = None,
    ) -> None:
        law = tip.law
        if law is None or law.radius != tip.radius:
            raise ValueError(
                f"the tip's law must have been measured on a tip with the same radius, "
                f"{tip.radius:g} m"
            )
        alive = np.ones(grid.shape, np.bool_) if active is None else active
        self.grid = grid
        self._law = law
        self._root_max, self._tilt_sine_max = law.root, math.sin(law.tilt)
        self._known = known = known or Uncertainty()
        self._weights = sum_weights(grid, tip.radius, alive)
        self._used = self._weights[0] > 0.0
        self._zero_sums, self._noise = np.array(law.rest), np.array(law.noise)
        # Sums due to a common shift of all cells, and moment [N·m] due to a slope of the zero
        # offset.
        self._shift = known.baseline * self._weights.sum(axis=1)
        self._zero_moment = known.slope / tip.radius * 0.5 * self._weights[3].sum()
        sum_std = math.hypot(math.sqrt(self._noise[0, 0]), self._shift[0])
        self._contact_threshold = _CONTACT_SIGMA * sum_std
        # Largest undetected d, at which the force equals the contact threshold.
        root = self._root_of(self._contact_threshold, 0.0, self._root_max)
        self._undetected_d = tip.radius * root**2
        self._seq: int | None = None
        self._last = ContactEstimate()

    def __call__(self, frame: NDArray[Any], pascal_per_count: float = 1.0) -> ContactEstimate:
        """Estimate the contact and return a new result; see `update` for the arguments."""
        before, self._last = self._last, ContactEstimate()
        try:
            return self.update(frame, pascal_per_count)
        finally:
            self._last = before

    def update(
        self, frame: NDArray[Any], pascal_per_count: float = 1.0, seq: int | None = None
    ) -> ContactEstimate:
        """Estimate the contact from a frame [rows, cols] of any numeric type.

        ``pascal_per_count`` converts readings to Pa. Each call returns the same result object.
        Raises ValueError if the shape is wrong.
        """
        result = self._last
        if seq is not None and seq == self._seq:
            return result
        if frame.shape != self.grid.shape:
            raise ValueError(f"a frame must have shape {self.grid.shape}, got {frame.shape}")
        readings = float(pascal_per_count) * frame.ravel()[self._used].astype(np.float64)
        finite = bool(np.isfinite(readings).all())
        sums = self._weights[:, self._used] @ readings - self._zero_sums
        result.peak = float(readings.max(initial=0.0)) if finite else 0.0
        result.contact = finite and bool(sums[0] > self._contact_threshold)
        result.d = result.tilt_x = result.tilt_y = 0.0
        result.covariance[:] = result.systematic[:] = 0.0
        result.invalid = Invalid.NONE if finite else Invalid.NOT_FINITE
        if result.contact:
            result.invalid = self._contact(sums, result)
            # If nearly all cells read high, the sensor needs a tare.
            above = np.count_nonzero(readings > ABOVE_PEAK * result.peak)
            if result.invalid and above > ABOVE_FRACTION * readings.size:
                result.invalid = Invalid.ABOVE_ZERO
        else:
            result.covariance[0, 0] = result.systematic[0, 0] = self._undetected_d**2
        self._seq = seq
        return result

    def reset(self) -> None:
        """Discard the sequence number of the last frame."""
        self._seq = None

    def _root_of(self, force: float, q: float, t: float) -> float:
        """Find t by Newton's method, such that the curve ``shown`` equals ``force``."""
        for _ in range(24):
            value, by_t, _ = _curve(self._law.shown, t, q)
            before = t
            t = min(max(t - (value - force) / by_t, 0.3 * t), _EXTRAPOLATION_MAX * self._root_max)
            if abs(t - before) < _TOLERANCE * self._root_max:
                break
        return t

    def _contact(self, sums: FloatArray, result: ContactEstimate) -> Invalid:
        """Compute the contact; check the range of the curves and the extent of the frame."""
        force, along, across, square = sums.tolist()
        moment = math.hypot(along, across)
        s_max = _EXTRAPOLATION_MAX * self._tilt_sine_max
        s = target = step = 0.0
        t = self._root_of(force, 0.0, self._root_max)
        for _ in range(_ITERATIONS_MAX):
            lever = max(_curve(self._law.lever, t, s * s)[0], 1e-9 * self._law.radius)
            target = moment / (force * lever)
            before = step
            step = min(target, s_max) - s
            if step * before < 0.0:
                step *= 0.5
            s += step
            t = self._root_of(force, s * s, t)
            if abs(step) < _TOLERANCE:
                break
        direction = np.array([along, across]) / moment if moment > 0.0 else np.array([1.0, 0.0])
        n = s * direction
        inverse, errors = self._errors(t, n)
        std = math.sqrt(direction @ errors[1:, 1:] @ direction)
        # Use the tilt range of the calibration presses as a prior. The prior matters if the
        # centroid barely determines the tilt. As in a Kalman update, the prior pulls the tilt
        # towards 0. The resulting error is common to all frames.
        prior = self._tilt_sine_max**2 * np.eye(2)
        pull = errors[:, 1:] @ np.linalg.inv(errors[1:, 1:] + prior)
        n -= pull[1:] @ n
        covariance = errors - pull @ errors[1:]
        inverse -= pull @ inverse[1:]
        systematic = covariance - inverse @ self._noise[:3, :3] @ inverse.T
        square_n = float(n @ n)
        t = self._root_of(force, square_n, t)
        result.d = self._law.radius * t * t
        result.tilt_x, result.tilt_y = np.arcsin(n).tolist()
        per_tilt = np.array([1.0, 1.0 / math.cos(result.tilt_x), 1.0 / math.cos(result.tilt_y)])
        result.covariance[:3, :3] = covariance * np.outer(per_tilt, per_tilt)
        result.systematic[:3, :3] = systematic * np.outer(per_tilt, per_tilt)
        extent = force * _curve(self._law.extent, t, square_n)[0]
        # A second contact would change the mean squared radius by more than the tolerance.
        tolerance = _EXTENT_ERROR_MAX * extent + _CONTACT_SIGMA * math.sqrt(self._noise[3, 3])
        agrees = abs(square - extent) < tolerance
        t_max = _EXTRAPOLATION_MAX * self._root_max * (1.0 - 1e-9)
        if not (t < t_max and target < s_max + 3.0 * std):
            return Invalid.OUT_OF_RANGE
        return Invalid.NONE if agrees else Invalid.MODEL_MISMATCH

    def _errors(self, t: float, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the partials ∂(d, n_x, n_y)/∂(sums), and the covariance of (d, n_x, n_y).

        The covariance includes the noise of the sums and the errors that all frames share.
        """
        law, known, q = self._law, self._known, float(n @ n)
        shown, shown_t, shown_q = _curve(law.shown, t, q)
        lever, lever_t, lever_q = _curve(law.lever, t, q)
        moment, moment_q = shown * lever, shown_q * lever + shown * lever_q
        per_d = 1.0 / (2.0 * law.radius * t)  # dt/dd
        partials = np.zeros((3, 3))  # ∂(sum, x moment, y moment)/∂(d, n_x, n_y)
        partials[0] = shown_t * per_d, *(2.0 * shown_q * n)
        partials[1:, 0] = (shown_t * lever + shown * lever_t) * per_d * n
        partials[1:, 1:] = moment * np.eye(2) + 2.0 * moment_q * np.outer(n, n)
        inverse = np.asarray(np.linalg.inv(partials))
        moment_error = (shown * math.hypot(law.lever_error, known.centre)) ** 2
        moment_error += self._zero_moment**2
        errors = np.diag([(shown * law.force_error) ** 2, moment_error, moment_error])
        by_gain = known.gain * np.array([shown, *(moment * n)])
        by_rotation = known.rotation * moment * np.array([0.0, -n[1], n[0]])
        for each in (self._shift[:3], by_gain, by_rotation):
            errors += np.outer(each, each)
        return inverse, np.asarray(inverse @ (self._noise[:3, :3] + errors) @ inverse.T)
