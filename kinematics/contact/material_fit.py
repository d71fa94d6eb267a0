"""Fit a smooth, monotonic stress-strain law to measured points.

The tangent modulus is a Bernstein polynomial on [0, 1], fitted by bounded least squares. The
polynomial's coefficients are positive, so the modulus is positive everywhere.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from softfinger import SoftfingerError
from softfinger.kinematics.compiled.layout import FloatArray

__all__ = ["MaterialError"]


MIN_POINTS = 4
_DEGREES = range(11)  # polynomial degrees of the modulus, in the order of trial
_NEGLIGIBLE_MISFIT = 1e-9  # negligible misfit, relative to the maximum stress
# A lower degree is accepted if its misfit is at most this multiple of the smallest misfit.
_MISFIT_RATIO_MAX = 1.5
_MISFIT_MAX = 0.05  # maximum misfit of a successful fit, relative to the maximum stress
_MODULUS_MIN = 1e-3  # minimum modulus, relative to the mean modulus
_EXTENSION_WEIGHT = 0.1  # weight of the points that extend the curve
_SMOOTHING = 1e-7  # weight of the second differences of the modulus, to prevent oscillation


class MaterialError(SoftfingerError, ValueError):
    """Error raised if the data do not yield a usable stress-strain law."""


def _checked(strain: ArrayLike, stress: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the points up to strain 1, excluding the origin. Raises MaterialError if invalid."""
    x = np.asarray(strain, dtype=np.float64)
    y = np.asarray(stress, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape:
        raise MaterialError(
            f"strain and stress must be two lists of equal length, got {x.shape} and {y.shape}"
        )
    wrong = []
    bad = np.flatnonzero(~(np.isfinite(x) & np.isfinite(y)))
    if bad.size:
        raise MaterialError(f"point {bad[0] + 1} is not finite: ({x[bad[0]]}, {y[bad[0]]})")
    if x.size < MIN_POINTS:
        wrong.append(f"too few points: found {x.size}, expected at least {MIN_POINTS}")
    if x.size and x[0] < 0.0:
        wrong.append(
            f"strain must not be negative, but the first point has {x[0]:.6g}; compression "
            "counts as positive"
        )
    for i in np.flatnonzero(np.diff(x) <= 0.0)[:3]:
        wrong.append(f"strain must increase, but point {i + 2} has {x[i + 1]:.6g} after {x[i]:.6g}")
    for i in np.flatnonzero(np.diff(y) <= 0.0)[:3]:
        wrong.append(
            f"not monotonic: stress must increase, but point {i + 2} has {y[i + 1]:.6g} Pa after "
            f"{y[i]:.6g} Pa"
        )
    top = float(np.max(np.abs(y))) if y.size else 0.0
    if x.size and (abs(y[0]) > 1e-3 * top if abs(x[0]) <= 1e-9 else x[0] > 0.0 >= y[0]):
        wrong.append(
            f"the curve must start at zero stress, but its first point has {y[0]:.6g} Pa at "
            f"strain {x[0]:.6g}; subtract the offset first"
        )
    if not wrong and x[-1] > 2.0:
        wrong.append(f"strain reaches {x[-1]:.6g}; strain must be a ratio, not a percentage")
    if wrong:
        raise MaterialError("the stress-strain points can't be used: " + "; ".join(wrong))
    used = (x > 1e-9) & (x <= 1.0)
    if used.sum() < MIN_POINTS - 1:
        raise MaterialError(
            f"too few points between strain 0 and 1: found {used.sum()}, expected at least "
            f"{MIN_POINTS - 1}"
        )
    return x[used], y[used]


def fit_law(strain: ArrayLike, stress: ArrayLike) -> tuple[list[Fraction], FloatArray]:
    """Fit σ(ε); return c_1, c_2, … [Pa], and the points' strains and misfits [Pa] as [2, n].

    The fit uses the lowest degree whose misfit is close to the smallest misfit of all degrees.
    Beyond the last point, the law is approximately linear.
    """
    x, y = _checked(strain, stress)
    top = float(y[-1])
    points, values = _continued(x, y / top)
    weights = np.where(np.arange(points.size) < x.size, 1.0, _EXTENSION_WEIGHT)
    tried: list[tuple[float, FloatArray, FloatArray]] = []
    for degree in _DEGREES:
        if degree <= 2 * x.size:
            modulus = _positive_modulus(points, values, weights, degree)
            misses = np.abs(_integrals(x, degree) @ modulus - y / top)
            tried.append((float(np.max(misses)), misses, modulus))
    enough = _MISFIT_RATIO_MAX * min(one[0] for one in tried) + _NEGLIGIBLE_MISFIT
    misfit, misses, modulus = next(one for one in tried if one[0] <= enough)
    if misfit > _MISFIT_MAX:
        raise MaterialError(
            "no smooth monotonic law fits the points: the best law deviates from the points by up "
            f"to {misfit * top:.4g} Pa (maximum stress: {top:.4g} Pa)"
        )
    rising = _monomials([Fraction(float(value)) * Fraction(top) for value in modulus])
    return [value / (j + 1) for j, value in enumerate(rising)], np.stack([x, misses * top])


def _continued(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Extend the points to strain 1 using the slope at the last points."""
    if x[-1] > 0.95:
        return x, y
    # Fit a parabola to the last third of the points. Clamp the parabola's final slope to 0.5 to 2
    # times the mean slope of the last quarter.
    last = max(3, x.size // 3)
    back = x[-last:] - x[-1]
    slope = float(np.polyfit(back, y[-last:], 2)[1])
    start = float(np.interp(0.75 * x[-1], [0.0, *x], [0.0, *y]))
    mean = (float(y[-1]) - start) / (0.25 * float(x[-1]))
    slope = min(max(slope, 0.5 * mean), 2.0 * mean)
    more = np.linspace(x[-1], 1.0, 2 + int(8 * (1.0 - x[-1])))[1:]
    return np.concatenate([x, more]), np.concatenate([y, y[-1] + slope * (more - x[-1])])


def _positive_modulus(x: FloatArray, y: FloatArray, weights: FloatArray, degree: int) -> FloatArray:
    """Fit the Bernstein coefficients of the modulus to the points, with a positive lower bound."""
    matrix = _integrals(x, degree) * weights[:, None]
    smooth = np.diff(np.eye(degree + 1), 2, axis=0)
    rows = np.concatenate([matrix, _SMOOTHING * smooth])
    right = np.concatenate([y * weights, np.zeros(len(smooth))])
    floor = _MODULUS_MIN * float(y[-1] / x[-1])
    return floor + nonnegative(rows, right - rows @ np.full(degree + 1, floor))


def _integrals(x: FloatArray, degree: int) -> FloatArray:
    """Return the integral of each Bernstein polynomial from 0 to x, [len(x), degree + 1]."""
    n = degree + 1
    above = np.stack([math.comb(n, j) * x**j * (1.0 - x) ** (n - j) for j in range(n + 1)], axis=1)
    sums = np.cumsum(above[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(sums[:, 1:] / n)


def _monomials(bernstein: list[Fraction]) -> list[Fraction]:
    """Convert Bernstein coefficients exactly to coefficients of ascending powers."""
    n = len(bernstein) - 1
    out = []
    for j in range(n + 1):
        total = sum(
            ((-1) ** (j - k) * math.comb(j, k) * bernstein[k] for k in range(j + 1)), Fraction(0)
        )
        out.append(math.comb(n, j) * total)
    return out


def nonnegative(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a least-squares problem subject to x ≥ 0 by Lawson and Hanson's active-set method."""
    count = matrix.shape[1]
    x = np.zeros(count)
    free = np.zeros(count, dtype=np.bool_)
    tolerance = 1e-13 * float(np.abs(matrix.T @ right).max(initial=1e-300))
    for _ in range(10 * count):
        gradient = matrix.T @ (right - matrix @ x)
        gradient[free] = -np.inf
        if free.all() or gradient.max() <= tolerance:
            break
        free[int(np.argmax(gradient))] = True
        while True:
            trial = np.zeros(count)
            trial[free] = np.linalg.lstsq(matrix[:, free], right, rcond=None)[0]
            low = free & (trial <= 0.0)
            if not low.any():
                x = trial
                break
            step = float(np.min(x[low] / (x[low] - trial[low])))
            x = x + step * (trial - x)
            x[low & (x <= 1e-15)] = 0.0
            free &= x > 0.0
    return x
