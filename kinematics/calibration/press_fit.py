"""Fit a tip's physics, modulus and position on the sensor to presses at known d and tilts.

`compare_tips` and `fit_centre` fit the tip's forward model to all cells of all frames by least
squares. `fit_modulus` uses only the forces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.calibration.calibration import (
    CalibrationError,
    golden_section,
    rms,
    stack_of,
)
from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.closed_form import POISSON, Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

_UNIT_MATERIAL = Material.constant(1.0)
_STEP = 1e-5  # step for numerical derivatives [m]
_PLACE_STEP = 2e-4  # position step [m]; large, because rim cells gain or lose whole sample points
_ROTATION_STEP = 1e-4  # rad
_ROTATION_STARTS = 8  # number of initial rotations to try
_TILT_MIN = math.radians(3.0)  # minimum range of tilts from which the rotation is determined
_UPRIGHT_ERROR = math.radians(0.5)
_PRESSED_SIGMA = 6.0  # minimum peak reading of a contact, as a multiple of the noise
_POISSON_TOLERANCE = 4e-3  # tolerance of ν
# Presses whose d [m] and θ [rad] differ by less than this count as repetitions.
_REPEATED_D, _REPEATED_THETA = 5e-5, 0.009
_DRIFT_MIN = 0.02  # smallest significant drift of E, limited by the errors of presses and tables


@dataclass(frozen=True)
class Presses:
    """Frames of presses at known d and θ, with tilts in the finger's plane."""

    frames: FloatArray  # [n, rows, cols] [Pa]
    d: FloatArray  # [n] [m]
    theta: FloatArray  # [n] [rad]
    noise: float  # standard deviation of a cell in these frames [Pa]
    used: NDArray[np.bool_]  # [n, rows, cols]; False for dead and saturated cells

    def of(
        self, tip: Fingertip, grid: SensorGrid, d: FloatArray, law: Material = _UNIT_MATERIAL
    ) -> FloatArray:
        """Return the modelled pressures of all used cells for a modulus of 1 Pa."""
        made = [
            grid.pressure(tip, law, float(depth), float(tilt))
            for depth, tilt in zip(np.maximum(d, 1e-9), self.theta, strict=True)
        ]
        return np.asarray(np.stack(made)[self.used])


@dataclass(frozen=True)
class Trend:
    """Modulus E of each press, and the drift of E with d.

    The drift is the relative change of a line, fitted to E(d), from the minimum to the maximum d.
    """

    d: FloatArray  # [n] [m]
    modulus: FloatArray  # E [n] [Pa]
    drift: float
    std: float  # standard deviation of the drift, based on the scatter about the line
    physics: str  # physics of the fitted tip

    @property
    def drifts(self) -> bool:
        """True if the drift of E is significant, i.e. if the model does not fit the tip."""
        return abs(self.drift) > max(2.0 * self.std, _DRIFT_MIN)

    @property
    def cause(self) -> str:
        """Probable cause of the drift, and models that may fit better."""
        more = "stiffens more" if self.drift > 0.0 else "softens, or stiffens less"
        solid = self.physics == "solid"
        other = (
            "a different base or face, or springs" if solid else "solid, or another material law"
        )
        return f"the tip {more} than the model; try {other}"


def trend(d: FloatArray, modulus: FloatArray, force: FloatArray, physics: str) -> Trend:
    """Fit a line to ``modulus`` [n] [Pa] versus ``d`` [n] [m], weighted by ``force`` [n]."""
    weight = force / force.max()
    span = np.ptp(d)
    rows = weight[:, None] * np.stack([np.ones(len(d)), (d - d.min()) / span], axis=1)
    (start, gain), *_ = np.linalg.lstsq(rows, weight * modulus, rcond=None)
    left = weight * modulus - rows @ (start, gain)
    variance = float(left @ left) / max(len(d) - 2, 1) * np.linalg.inv(rows.T @ rows)[1, 1]
    middle = start + 0.5 * gain
    return Trend(d, modulus, float(gain / middle), math.sqrt(variance) / abs(middle), physics)


def first_cycle(d: FloatArray, theta: FloatArray, force: FloatArray) -> float | None:
    """Compare first presses with repetitions; return the mean relative excess of the first force.

    Filled rubber softens over its first cycles (Mullins, 1948), so one fit cannot describe both
    first and repeated presses. The mean is taken over the poses (``d`` [n] [m], ``theta`` [n]
    [rad]) that occur more than once. The result is None if no pose is repeated.
    """
    poses = np.round(np.stack([d / _REPEATED_D, theta / _REPEATED_THETA], axis=1))
    _, which = np.unique(poses, axis=0, return_inverse=True)
    again = [force[which == pose] for pose in range(which.max() + 1)]
    more = [float(each[0] / each[1:].mean()) for each in again if len(each) > 1]
    return float(np.mean(more)) - 1.0 if more else None


@dataclass(frozen=True)
class TipFit:
    """Result of fitting one tip model to the presses.

    The errors are those of the estimator for this tip. They include only frames with a valid
    estimate. For a solid tip, the fit also determines ν.
    """

    tip: Fingertip
    modulus: float  # Pa
    offset: float  # zero offset of d [m]
    chi2: float  # mean squared residual per cell, divided by the noise variance
    d_error: float = math.nan  # rms error of d [m]
    theta_error: float = math.nan  # rms error of the tilt [rad]
    force_error: float = math.nan  # relative rms difference of estimated force and frame sum
    trend: Trend | None = None  # E of each press
    valid: float = 0.0  # fraction of frames with a valid estimate
    law: Material = _UNIT_MATERIAL  # material law for a modulus of 1 Pa at zero strain

    @property
    def material(self) -> Material:
        """Fitted material of the tip."""
        return _scaled(self.law, self.modulus)


def _scaled(law: Material, factor: float) -> Material:
    return Material(tuple(each * Fraction(factor) for each in law.coefficients), name=law.name)


def fit_tip(
    presses: Presses, tip: Fingertip, grid: SensorGrid, law: Material = _UNIT_MATERIAL
) -> TipFit:
    """Fit the modulus and the zero offset of d for one ``tip`` model by the Gauss-Newton method.

    ``chi2`` is infinite if the fitted modulus is not positive.
    """
    readings = presses.frames[presses.used]
    offset = 0.0
    for _ in range(6):
        shape = presses.of(tip, grid, presses.d - offset, law)
        slope = (presses.of(tip, grid, presses.d - offset + _STEP, law) - shape) / _STEP
        columns = np.stack([shape, -slope], axis=1)
        modulus, shift = np.linalg.lstsq(columns, readings, rcond=None)[0]
        if not modulus > 0.0:
            return TipFit(tip, float(modulus), offset, math.inf, law=law)
        step = float(np.clip(shift / modulus, -5e-4, 5e-4))
        if abs(step) < 1e-7:
            break
        offset += step
    misfit = readings - columns @ np.array([modulus, shift])
    freedom = max(len(readings) - 2, 1)
    chi2 = float(misfit @ misfit) / (presses.noise**2 * freedom)
    return TipFit(tip, float(modulus), offset, chi2, law=law)


def compare_tips(
    presses: Presses,
    radius: float,
    grid: SensorGrid,
    active: NDArray[np.bool_],
    material: Material = _UNIT_MATERIAL,
) -> list[TipFit]:
    """Fit spring and solid models of the tip; return the fits in order of quality, best first.

    Models whose fitted modulus is not positive are omitted.
    Springs are fitted with a constant modulus. If ``material`` is nonlinear, springs are also
    fitted with the law of ``material``. For solid rubber, ν is a free parameter. Both base types
    are fitted with a frictionless face. The better base type is then also fitted with a sticking
    face. Solid models are omitted if a press is outside the range of their data.
    """
    fits = [fit_tip(presses, Fingertip(radius), grid)]
    if not material.is_linear:
        law = _scaled(material, 1.0 / material.reference_modulus)
        fits.append(fit_tip(presses, Fingertip(radius), grid, law))
    bonded = Fingertip(radius, "solid")
    if covers(bonded, presses.d, presses.theta).all():
        bases = bonded, replace(bonded, base="lying")
        both = [_best_poisson(presses, tip, grid) for tip in bases]
        better = min(both, key=lambda fit: fit.chi2).tip
        fits += [*both, _best_poisson(presses, replace(better, face="sticking"), grid)]
    fits = [_with_errors(presses, each, grid, active) for each in fits if each.chi2 < math.inf]
    return sorted(fits, key=lambda fit: fit.chi2)


def covers(tip: Fingertip, d: FloatArray, theta: FloatArray) -> NDArray[np.bool_]:
    """Return a mask [n] of the contacts that are within the range of the tip's contact table."""
    inside = ContactTable.build(tip, _UNIT_MATERIAL)(d, theta, edge=True).inside
    return np.asarray(inside, np.bool_)


def require_covered(
    step: str, tip: Fingertip, d: FloatArray, theta: FloatArray, offset: float = 0.0
) -> None:
    """Raise CalibrationError if the tip's contact table does not cover all contacts."""
    inside = covers(tip, d - offset, theta)
    if not inside.all():
        k = int(np.argmin(inside))
        raise CalibrationError(
            f"{step}: d = {d[k] * 1e3:g} mm at θ = {math.degrees(theta[k]):.3g}° is outside the "
            f"range of the model (tip.physics = {tip.physics}): reduce d or θ"
        )


def _best_poisson(presses: Presses, tip: Fingertip, grid: SensorGrid) -> TipFit:
    def at(poisson: float) -> TipFit:
        return fit_tip(presses, replace(tip, poisson=poisson), grid)

    inner = golden_section(lambda poisson: at(poisson).chi2, *POISSON, _POISSON_TOLERANCE)
    return min((at(poisson) for poisson in (inner, *POISSON)), key=lambda fit: fit.chi2)


def _with_errors(
    presses: Presses, fit: TipFit, grid: SensorGrid, active: NDArray[np.bool_]
) -> TipFit:
    """Return a copy of the fit that includes the estimator's errors."""
    table = ContactTable.build(fit.tip, fit.material)
    estimator = ContactEstimator(fit.tip, fit.material, grid, presses.noise, active=active)
    area = math.prod(grid.pitches)
    shapes = np.zeros(presses.frames.shape)
    shapes[presses.used] = presses.of(fit.tip, grid, presses.d - fit.offset, fit.law)
    pressed = shapes.any(axis=(1, 2))
    d, shown, seen = presses.d[pressed], shapes[pressed], presses.frames[pressed]
    if np.ptp(d) > 0.0:
        alone = (shown * seen).sum(axis=(1, 2)) / (shown**2).sum(axis=(1, 2))
        fit = replace(fit, trend=trend(d, alone, shown.sum(axis=(1, 2)), fit.tip.physics))
    errors = []
    for frame, used, d, theta in zip(
        presses.frames, presses.used, presses.d - fit.offset, presses.theta, strict=True
    ):
        found = estimator(frame)
        if not (found.valid and found.contact):
            continue
        tilt = math.asin(min(math.hypot(math.sin(found.tilt_x), math.sin(found.tilt_y)), 1.0))
        force = found.gain * float(table(found.d, tilt).force)
        measured = float(frame[used].sum()) * area
        tilt_error = math.hypot(found.tilt_x - theta, found.tilt_y)
        errors.append([found.d - d, tilt_error, force - measured, measured])
    if not errors:
        return fit
    d_error, theta_error, off, forces = np.sqrt(np.mean(np.square(errors), axis=0))
    return replace(
        fit,
        d_error=float(d_error),
        theta_error=float(theta_error),
        force_error=float(off / forces),
        valid=len(errors) / len(presses.frames),
    )


@dataclass(frozen=True)
class Modulus:
    """Result of `fit_modulus` for the model F(d − d₀, θ)."""

    modulus: float  # E [Pa]
    offset: float  # d₀ [m]
    errors: FloatArray  # relative force errors [n]
    residual: float  # rms of the errors
    trend: Trend  # E at each load


def fit_modulus(d: ArrayLike, theta: ArrayLike, force: ArrayLike, tip: Fingertip) -> Modulus:
    """Fit the constant modulus of a tip and the zero offset of d to a compression run.

    The fit minimises the squared relative errors. ``d`` [m], ``theta`` [rad] and ``force`` [N] have
    shape [n]. ``force`` is measured by the sensor. Raises CalibrationError if there are too few
    points, if the force does not increase with d, or if a point is outside the contact table.
    """
    depth, tilt, load = (np.asarray(each, np.float64) for each in (d, theta, force))
    if not depth.shape == tilt.shape == load.shape:
        raise CalibrationError("modulus: expected one value of d and one force for each frame")
    used = (depth > 0.0) & (load > 0.0)
    if np.count_nonzero(used) < 3 or np.ptp(depth[used]) <= 0.0:
        raise CalibrationError("modulus: expected at least three contact frames with different d")
    depth, tilt, load = depth[used], tilt[used], load[used]
    if not np.polyfit(depth, load, 1)[0] > 0.0:
        raise CalibrationError("modulus: the force does not increase with d")
    unit, offset, modulus = ContactTable.build(tip, Material.constant(1.0)), 0.0, 0.0
    for _ in range(30):
        c = unit(np.maximum(depth - offset, 1e-9), tilt, edge=True)
        columns = np.stack([c.force, -c.force_d], axis=1) / load[:, None]
        modulus, shift = np.linalg.lstsq(columns, np.ones(len(load)), rcond=None)[0].tolist()
        if not modulus > 0.0 or np.count_nonzero(depth > offset) < 3:
            raise CalibrationError(
                "modulus: the force does not increase with d as it does in a contact; check that "
                "the tip touches the sensor"
            )
        step = float(np.clip(shift / modulus, -5e-4, 5e-4))
        offset += step
        if abs(step) < 1e-9:
            break
    require_covered("modulus", tip, depth, tilt, offset)
    fitted = modulus * unit(np.maximum(depth - offset, 1e-9), tilt).force
    errors = fitted / load - 1.0
    alone = trend(depth, modulus / (1.0 + errors), load, tip.physics)
    return Modulus(modulus, offset, errors, rms(errors), alone)


@dataclass(frozen=True)
class Centre:
    """Result of `fit_centre`: position of the tip in sensor axes."""

    centre: tuple[float, float]  # m
    rotation: float | None  # rotation of the sensor [rad]; None if no press was tilted
    residual: float  # change in the centre during the last iteration [m]
    std: float  # standard deviation of each coordinate of the centre [m]


def fit_centre(
    frames: ArrayLike,
    theta: ArrayLike,
    tip: Fingertip,
    material: Material,
    grid: SensorGrid,
    noise: float,
    active: NDArray[np.bool_] | None = None,
) -> Centre:
    """Determine the tip centre and sensor rotation from presses at known tilts ``theta`` [n] [rad].

    The tilts are in the finger's plane. The fit uses all cells of the ``frames`` [n, rows, cols]
    [Pa]. The modulus of a spring tip need not be known. Raises CalibrationError if a frame does not
    show a contact, or if all tilts are equal but nonzero.
    """
    stack = stack_of(frames, "centre")
    s = np.sin(np.asarray(theta, np.float64))
    if s.shape != (len(stack),):
        raise CalibrationError("centre: expected a tilt for each press, 0 for an upright press")
    tilted = float(np.ptp(s)) > math.sin(_TILT_MIN)
    if not tilted and float(np.abs(s).max()) > math.sin(_UPRIGHT_ERROR):
        raise CalibrationError(
            f"centre: the tilts differ by less than {math.degrees(_TILT_MIN):g}°, so tilt and "
            "position can't be separated; use only upright presses, or add presses with a larger "
            "tilt"
        )
    for k, frame in enumerate(stack):
        if not frame.max() > _PRESSED_SIGMA * noise:
            raise CalibrationError(f"centre: press {k + 1} did not produce a valid contact")
    used = np.broadcast_to(True if active is None else active, stack.shape)
    force = (stack * used).sum(axis=(1, 2)) * math.prod(grid.pitches)
    d = np.linspace(0.0, 0.4 * tip.radius, 401)
    depths = np.interp(force, ContactTable.build(tip, material)(d, 0.0).force, d)
    presses = Presses(stack, depths, np.arcsin(s), noise, used)
    placed, last_step, std = _fit_place(presses, tip, material, grid, tilted)
    # Add the uncertainty of the upright orientation. An orientation error shifts the centroid by
    # the product of moment arm and error.
    lever = (0.5 if tip.physics == "solid" else 1.0) * tip.radius
    std = math.hypot(std, lever * _UPRIGHT_ERROR / math.sqrt(3.0 * len(s)))
    rotation = (placed.rotation + math.pi) % (2.0 * math.pi) - math.pi if tilted else None
    return Centre(placed.centre, rotation, last_step, std)


def _fit_place(
    presses: Presses, tip: Fingertip, material: Material, grid: SensorGrid, rotate: bool
) -> tuple[SensorGrid, float, float]:
    """Fit the tip centre and, if ``rotate`` is True, the sensor rotation.

    The tilts are known. The Gauss-Newton method also fits the modulus of a spring tip and the depth
    of each press. The initial depths are ``presses.d``. Returns the grid, the last step [m] and the
    standard deviation of the centre [m].
    """
    gain, free_gain = 1.0, tip.physics == "springs"
    readings = presses.frames[presses.used] / material.reference_modulus
    depths = presses.d.copy()

    def misfit(tried: SensorGrid) -> float:
        return float(np.linalg.norm(presses.of(tip, tried, depths) - readings))

    if rotate:
        turns = 2.0 * math.pi * np.arange(_ROTATION_STARTS) / _ROTATION_STARTS
        grid = min((replace(grid, rotation=float(each)) for each in turns), key=misfit)
    owner = np.nonzero(presses.used)[0]
    shift = math.inf
    for _ in range(12):
        now = gain * presses.of(tip, grid, depths)
        by_depth = (gain * presses.of(tip, grid, depths + _STEP) - now) / _STEP
        columns = [np.where(owner == k, by_depth, 0.0) for k in range(len(depths))]
        x, y = grid.centre
        tried = [
            (replace(grid, centre=(x + _PLACE_STEP, y)), _PLACE_STEP),
            (replace(grid, centre=(x, y + _PLACE_STEP)), _PLACE_STEP),
        ]
        if rotate:
            turned = replace(grid, rotation=grid.rotation + _ROTATION_STEP)
            tried.append((turned, _ROTATION_STEP))
        columns += [(gain * presses.of(tip, each, depths) - now) / step for each, step in tried]
        columns += [now] * free_gain
        jacobian = np.stack(columns, axis=1)
        found = np.linalg.lstsq(jacobian, readings - now, rcond=None)[0]
        step, place = found[: len(depths)], found[len(depths) :]
        gain *= 1.0 + float(np.clip(place[-1], -0.3, 0.3)) * free_gain
        depths = np.clip(depths + step, 0.3 * depths, 0.95 * tip.radius)
        rotation = grid.rotation + (float(np.clip(place[2], -0.5, 0.5)) if rotate else 0.0)
        x_step, y_step = np.clip(place[:2], -2e-3, 2e-3).tolist()
        shift = math.hypot(x_step, y_step)
        grid = replace(grid, centre=(x + x_step, y + y_step), rotation=rotation)
        if shift < 1e-7:
            break
    variance = float(((readings - now) ** 2).mean())
    x = len(depths)
    std = math.sqrt(variance * float(np.linalg.inv(jacobian.T @ jacobian)[x, x]))
    return grid, shift, std
