"""Fit the curves of a measured tip model, `TipCurves`, to calibration presses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.tip_curves import POWERS, SQUARES, Curve, TipCurves, rises
from softfinger.kinematics.estimation.measured import sum_weights
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_PRESS_COUNT_MIN = 6  # minimum number of presses
_UPRIGHT_TILT = math.radians(1.0)
_TILTED_MIN = math.radians(5.0)
_CURVE_ERROR_MAX = 0.05  # maximum error of the curves, relative to the force or the radius
_STAGE_ERROR = 2e-3  # assumed relative error of the test stage and its force sensor


@dataclass(frozen=True)
class PressSums:
    """Presses at known d and θ, with tilts in the finger's plane."""

    d: FloatArray  # [n] [m]
    theta: FloatArray  # [n] [rad]
    frames: Sequence[FloatArray]  # frames of each press [k, rows, cols] [Pa], as in the daemon
    # Mean frames without the bias of noise that is clipped at zero [n, rows, cols] [Pa].
    pressures: FloatArray
    rest: FloatArray  # bias of a tip without contact [rows, cols] [Pa]
    active: NDArray[np.bool_]  # False for dead cells [rows, cols]
    gain: float = 1.0  # ratio of the true force to the sensor's force


def fit_measured(presses: PressSums, radius: float, grid: SensorGrid) -> TipCurves:
    """Fit the curves of a tip, and the position of the tip on the sensor.

    ``grid`` is the sensor grid without offset or rotation.

    Raises CalibrationError.
    """
    used = presses.d > 0.0
    d, theta = presses.d[used], presses.theta[used]
    tilted = np.abs(theta) > _TILTED_MIN
    if (
        len(d) < _PRESS_COUNT_MIN
        or len(np.unique(d)) < 3
        or tilted.sum() < 2
        or not (np.abs(theta) < _UPRIGHT_TILT).any()
    ):
        raise CalibrationError(
            f"found {len(d)} presses at {len(np.unique(d))} depths, {tilted.sum()} of them "
            f"tilted; expected at least {_PRESS_COUNT_MIN} presses at 3 depths, including upright "
            "presses and 2 presses tilted by 5° or more"
        )
    frames = [each for each, use in zip(presses.frames, used, strict=True) if use]
    weights = sum_weights(grid, radius, presses.active)
    centre, rotation = _place(_sums(frames, weights, presses.rest), theta)
    placed = replace(grid, centre=centre, rotation=rotation)
    weights = sum_weights(placed, radius, presses.active)
    sums = _sums(frames, weights, presses.rest)
    noise = _noise(frames, weights)
    force = presses.gain * (presses.pressures[used].reshape(len(d), -1) @ weights[0])
    t, s = np.sqrt(d / radius), np.sin(theta)
    q, root, square = s * s, float(t.max()), float(np.max(s * s))
    number = len({round(float(x), 3) for x in np.abs(theta)})
    squares = min(number, SQUARES)
    scatter = np.sqrt(noise.diagonal()[:, None] / [len(each) for each in frames])

    def curve(
        y: FloatArray, sigma: FloatArray, powers: Sequence[int], times: FloatArray, name: str
    ) -> Curve:
        def valid(found: FloatArray) -> bool:
            if name == "lever":
                found = np.concatenate([np.zeros((1, SQUARES)), found[:-1]])  # t · lever increases
            return name == "extent" or rises(found, root, square)

        best = _best_fit(
            (t, q, times), y, np.hypot(sigma, _STAGE_ERROR * np.abs(y)), powers, squares, valid
        )
        if best is None:
            raise CalibrationError(f"no smooth increasing curve fits the presses ({name})")
        return tuple(map(tuple, best.tolist()))

    one = np.ones(len(d))
    push = curve(force / np.cos(theta), scatter[0], (3, 4, 5), one, "push")
    shown = curve(sums[0], scatter[0], (3, 4, 5), one, "shown")
    lever = curve(sums[1], scatter[1], (0, 1, 2, 3), s * sums[0], "lever")
    extent = curve(sums[3], scatter[3], (0, 2, 4), sums[0], "extent")
    law = TipCurves(
        radius=radius,
        deepest=float(d.max()),
        tilt=float(np.abs(theta).max()),
        push=push,
        shown=shown,
        lever=lever,
        extent=extent,
        centre=centre,
        rotation=rotation,
        rest=tuple((presses.rest.ravel() @ weights.T).tolist()),
        noise=tuple(map(tuple, noise.tolist())),
        force_error=0.0,
        lever_error=0.0,
        presses=len(d),
    )
    misses = np.stack(
        [
            law.at(push, d, theta) * np.cos(theta) - force,
            law.at(shown, d, theta) - sums[0],
            s * law.at(lever, d, theta) * sums[0] - sums[1],
            -sums[2],
        ]
    )
    missed = [
        _excess_error(misses[k] / sums[0], scatter[m] / sums[0], _STAGE_ERROR * smallest)
        for k, m, smallest in ((0, 0, 1.0), (1, 0, 1.0), (2, 1, radius), (3, 2, radius))
    ]
    force_error, lever_error = max(missed[:2]), max(missed[2:])
    if max(force_error, lever_error / radius) > _CURVE_ERROR_MAX:
        raise CalibrationError(
            "the best-fitting smooth, increasing curves differ from the presses by "
            f"{force_error:.1%} in force and {lever_error * 1e3:.2f} mm in centroid position"
        )
    return replace(law, force_error=force_error, lever_error=lever_error)


def _excess_error(misses: FloatArray, noise: FloatArray, smallest: float) -> float:
    """Return the weighted standard deviation of the residuals in excess of their noise."""
    weight = 1.0 / (noise**2 + smallest**2)
    return math.sqrt(max(float(weight @ (misses**2 - noise**2)) / float(weight.sum()), 0.0))


def _sums(frames: Sequence[FloatArray], weights: FloatArray, rest: FloatArray) -> FloatArray:
    """Return the four sums of each press minus the sums without load, [4, presses]."""
    means = np.stack([each.mean(axis=0) for each in frames]) - rest
    return np.asarray(weights @ means.reshape(len(frames), -1).T)


def _noise(frames: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """Estimate the covariance [4, 4] of one frame's sums from the scatter within each press."""
    if min(map(len, frames)) < 5:
        raise CalibrationError(
            "expected at least five frames for each press, so that the noise can be measured"
        )
    each = [weights @ every.reshape(len(every), -1).T for every in frames]
    return np.asarray(np.mean([np.cov(sums) for sums in each], axis=0))


def _place(sums: FloatArray, theta: FloatArray) -> tuple[tuple[float, float], float]:
    """Estimate tip centre [m] from upright presses, and rotation [rad] from tilted presses."""
    x, y = sums[1:3] / sums[0]
    weight = np.where(np.abs(theta) < _UPRIGHT_TILT, sums[0], 0.0)
    weight /= weight.sum()
    centre = float(weight @ x), float(weight @ y)
    along = np.sin(theta) * sums[0]
    # For a rotation ρ, the finger's x axis is (cos ρ, −sin ρ) in sensor axes.
    return centre, math.atan2(-float(along @ (y - centre[1])), float(along @ (x - centre[0])))


def _best_fit(
    points: tuple[FloatArray, FloatArray, FloatArray],
    y: FloatArray,
    sigma: FloatArray,
    powers: Sequence[int],
    squares: int,
    valid: Callable[[FloatArray], bool],
) -> FloatArray | None:
    """Return the valid curve with the lowest BIC for y = times · curve(t, q)."""
    t, q, times = points
    best, smallest = None, math.inf
    for count in range(1, len(powers) + 1):
        for chosen in itertools.combinations(powers, count):
            for wide in range(1, squares + 1):
                terms = [(i, j) for i in chosen for j in range(wide)]
                if len(terms) > len(y) - 2:
                    continue
                rows = np.stack([times * t**i * q**j for i, j in terms], axis=1) / sigma[:, None]
                found = np.linalg.lstsq(rows, y / sigma, rcond=None)[0]
                cost = float(np.sum((rows @ found - y / sigma) ** 2)) + len(terms) * math.log(
                    len(y)
                )
                made = np.zeros((POWERS, SQUARES))
                made[tuple(np.transpose(terms))] = found
                if cost < smallest and valid(made):
                    best, smallest = made, cost
    return best
