"""Compute the calibration file's contents from the loads of each calibration step.

`kinematics.calibration.calibration` contains the mathematics, and
`daemon.perception.calibration_file` defines the file format.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CentreStep,
    Converter,
    CurveStep,
    EquilibrateStep,
    ModulusStep,
    TareStep,
    calibration_of,
    now,
    sensor_of,
)
from softfinger.daemon.perception.finger_model import calibrated_grid
from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.calibration.calibration import (
    CalibrationError,
    above_zero,
    equilibrate,
    fit_curve,
    fit_relaxation,
    tare,
    without_clipping,
)
from softfinger.kinematics.calibration.measured_fit import PressSums, fit_measured
from softfinger.kinematics.calibration.press_fit import (
    Presses,
    TipFit,
    Trend,
    compare_tips,
    covers,
    first_cycle,
    fit_centre,
    fit_modulus,
    require_covered,
)
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.contact.tip_curves import TipCurves
from softfinger.kinematics.estimation.measured import MeasuredEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.calibration.calibration_frames import Loads
from softfinger.tools.calibration.calibration_plot import Map, Panel, Points
from softfinger.tools.calibration.compression import tip_name, tip_settings

FloatArray = NDArray[np.float64]
_UNDONE: dict[str, Any] = {"modulus": None, "law": None, "scales": None, "wants": {}}
# If the rubber softens by more than this fraction after the first loads, a warning is printed. The
# changes caused by the test plate and noise are smaller.
_SOFTENS = 0.03
# New calibration, summary line, and plot panels.
Done = tuple[Calibration, str, tuple[Panel, ...]]


def begin(arguments: argparse.Namespace, settings: Settings) -> Calibration:
    """Load the calibration file or create a new calibration. Raises CalibrationFileError."""
    sensor = sensor_of(settings, FINGERS.index(arguments.finger))
    if not arguments.file.exists():
        return Calibration(sensor=sensor, date=now())
    return calibration_of(sensor, arguments.file)


@dataclass(frozen=True)
class Step:
    """Inputs to one step, and quantities that several steps use."""

    arguments: argparse.Namespace
    settings: Settings
    calibration: Calibration
    loads: Loads

    @cached_property
    def converter(self) -> Converter:
        """Converter from counts to pressure, based on the calibration steps completed so far."""
        return Converter(self.calibration, self.settings.tactile.pascal_per_count)

    @property
    def d(self) -> FloatArray:
        """Displacement at each load [m]. Raises CalibrationError if it is not known."""
        if "d" not in self.loads.truths:
            raise CalibrationError(
                f"{self.arguments.step}: expected --d, or a single recording that contains d"
            )
        return self.loads.truths["d"]

    @property
    def theta(self) -> FloatArray:
        """Tilt at each load [rad]."""
        return self.loads.truths.get("theta", np.zeros(len(self.loads.frames)))

    @cached_property
    def saturated(self) -> NDArray[np.bool_]:
        """Mask of the cells that saturated at each load, bool [loads, rows, cols]."""
        full = self.calibration.sensor.full_count
        return np.stack([(frames >= full).any(axis=0) for frames in self.loads.frames])

    @cached_property
    def over(self) -> list[FloatArray]:
        """Mean counts minus the zero offset, times the gains; clipping at 0 is corrected."""
        tare, zero, gain = self.calibration.tare, self.converter.zero, self.converter.gain
        means = [frames.mean(axis=0) for frames in self.loads.frames]
        if tare is None or self.settings.tactile.threshold:
            return [(each - zero) * gain for each in means]
        return [without_clipping(each, zero, tare.noise) * gain for each in means]

    @cached_property
    def readings(self) -> list[FloatArray]:
        """Mean readings at each load, without the noise of cells far from the contact."""
        noise = self.calibration.tare.noise if self.calibration.tare else 0.0
        return [
            above_zero(np.maximum(each, 0.0), noise, len(frames))
            for each, frames in zip(self.over, self.loads.frames, strict=True)
        ]

    @cached_property
    def pressures(self) -> FloatArray:
        """Mean pressure [Pa] at each load, float64 [loads, rows, cols]."""
        return np.stack([self.converter(frames).mean(axis=0) for frames in self.loads.frames])

    @property
    def cell_area(self) -> float:
        """Cell area [m²]."""
        return math.prod(self.calibration.sensor.pitch)

    @property
    def plain_grid(self) -> SensorGrid:
        """Sensor grid without offset or rotation."""
        sensor = self.calibration.sensor
        return SensorGrid(sensor.rows, sensor.cols, sensor.pitch)

    def result(self, **steps: Any) -> Calibration:
        """Return the calibration updated with ``steps``."""
        return self.calibration.model_copy(update={"date": now(), **steps})


def done(step: Step) -> Done:
    """Compute the step. Raises CalibrationError."""
    truths = step.loads.truths
    if not step.loads.frames:
        raise CalibrationError("the run does not contain any frames with d above 0")
    for name, values in truths.items():
        if not np.isfinite(values).all():
            raise CalibrationError(f"{name}: found a value that is not finite")
    radius = step.settings.tip.radius
    if "d" in truths and (deepest := float(truths["d"].max())) > radius:
        raise CalibrationError(
            f"d: found {deepest * 1e3:g} mm, expected at most {radius * 1e3:g} mm, the tip's radius"
        )
    if "theta" in truths and (most := float(np.abs(truths["theta"]).max())) >= 0.5 * math.pi:
        raise CalibrationError(f"theta: found {math.degrees(most):g}°, expected less than 90°")
    return _STEPS[step.arguments.step](step)


def _kept(kind: type[Any], found: object, **more: Any) -> Any:
    """Create a step of type ``kind`` from the fields of ``found`` and ``more``."""
    values = {name: getattr(found, name) for name in kind.model_fields if hasattr(found, name)}
    lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
    return kind(date=now(), **(lists | more))


def _tare(step: Step) -> Done:
    found = tare(np.concatenate(step.loads.frames))
    noise = float(np.median(found.noise))
    count = sum(map(len, step.loads.frames))
    rho = found.correlation
    calibration = step.result(tare=_kept(TareStep, found, noise=noise, frames=count))
    if not Converter(calibration, step.settings.tactile.pascal_per_count).saturation > 0.0:
        raise CalibrationError(
            "tare: most cells are saturated, expected an unloaded tip; check the sensor and "
            "tactile.full_count"
        )
    line = (
        f"{count} frames, zero offset up to {found.zero.max():.1f} counts, noise {noise:.2f} counts"
    )
    if rho.size:
        beside = max(float(rho[0, 1:2].sum()), float(rho[1:2, 0].sum()))
        line += f", correlation {beside:.2f} between neighbouring cells"
    if found.drift > 0.0:
        line += f", common drift of all cells {found.drift:.2f} counts"
    spread = Map("noise, standard deviation [counts]", found.noise)
    return calibration, line, (Map("zero [counts]", found.zero), spread)


def _refuse_saturation(step: Step) -> None:
    for k in np.flatnonzero(step.saturated.any(axis=(1, 2))):
        raise CalibrationError(
            f"{step.arguments.step}: load {k + 1} saturates a cell, so it can't be used; reduce "
            "the load"
        )


def _equilibrate(step: Step) -> Done:
    _refuse_saturation(step)
    found = equilibrate(step.loads.frames, step.converter.zero)
    dead = int(np.count_nonzero(found.gain == 0.0))
    result = _kept(EquilibrateStep, found, dead=dead)
    line = (
        f"{len(step.loads.frames)} pressures, cells differ by {found.spread:.2%} rms before and "
        f"{found.residual:.2%} after; {dead} dead cells"
    )
    calibration = step.result(equilibrate=result, curve=None, **_UNDONE)
    return calibration, line, (Map("gain of each cell (0: dead cell)", found.gain),)


def _curve(step: Step) -> Done:
    truths, sensor = step.loads.truths, step.calibration.sensor
    force = truths.get("force")
    if force is None:
        d = truths.get("d")
        if d is None:
            raise CalibrationError(
                "curve: expected --force or --d, or a single recording that contains force or d"
            )
        # Use the profile's material to compute the force on the whole footprint.
        tip, material = make_tip(step.settings), make_material(step.settings.material)
        require_covered("curve", tip, d, step.theta)
        pressures = [
            step.plain_grid.pressure(tip, material, float(x), float(theta))
            for x, theta in zip(d, step.theta, strict=True)
        ]
        force = np.array([each.sum() * step.cell_area for each in pressures])
    _refuse_saturation(step)
    gains = step.calibration.equilibrate
    full = float(sensor.full_count) * max(map(max, gains.gain) if gains else [1.0])
    found = fit_curve(step.arguments.kind, step.readings, force, step.cell_area, full)
    result = _kept(CurveStep, found)
    line = f"{found.kind} from {len(force)} loads, force error {found.residual:.2%} rms"
    left = Points("residuals", "known [N]", "relative error [%]", force, 100.0 * found.errors)
    return step.result(curve=result, **_UNDONE), line, (left,)


def _centre(step: Step) -> Done:
    found = fit_centre(
        step.pressures,
        step.theta,
        make_tip(step.settings),
        make_material(step.settings.material),
        step.plain_grid,
        step.settings.tactile.noise,
        step.converter.live,
    )
    result = _kept(CentreStep, found)
    x, y = found.centre
    rotation = (
        "rotation not measured, because all presses were upright"
        if found.rotation is None
        else f"rotation {math.degrees(found.rotation):.2f}°"
    )
    line = (
        f"tip at ({x * 1e3:.3f}, {y * 1e3:.3f}) ± {found.std * 1e3:.3f} mm; {rotation}; "
        f"converged to {found.residual * 1e6:.0f} µm"
    )
    return step.result(centre=result), line, (Map("last press [Pa]", step.pressures[-1]),)


def _modulus(step: Step) -> Done:
    d, theta = step.d, step.theta
    pressed = zip(step.pressures, step.readings, strict=True)
    force = np.array([each[reading > 0.0].sum() for each, reading in pressed]) * step.cell_area
    whole = ~step.saturated.any(axis=(1, 2))  # Saturated cells read less than their actual load.
    tip = make_tip(step.settings)
    found = fit_modulus(d[whole], theta[whole], force[whole], tip=tip)
    line = (
        f"E = {found.modulus / 1e6:.4f} MPa from {np.count_nonzero(whole)} loads, zero offset of "
        f"d {found.offset * 1e3:.3f} mm, force error {found.residual:.2%} rms"
    )
    line += f"; {_over_d(found.trend)}"
    if not whole.all():
        line += f"; {np.count_nonzero(~whole)} saturated frames were excluded"
    result = _kept(ModulusStep, found)
    d, theta, force = d[whole], theta[whole], force[whole]
    table = ContactTable.build(tip, Material.constant(found.modulus))
    model = table(d - found.offset, theta, edge=True).force
    shown = Points("constant E", "d [mm]", "F [N]", d * 1e3, force, model)
    alone = found.trend.modulus / 1e6
    each = Points("E of each load", "d [mm]", "E [MPa]", found.trend.d * 1e3, alone)
    return step.result(modulus=result, scales=None), line, (shown, each)


def _law(step: Step) -> Done:
    d, theta, settings = step.d, step.theta, step.settings
    if len(d) < 3 or np.ptp(d) <= 0.0:
        raise CalibrationError("law: expected at least three presses at different values of d")
    finger = FINGERS.index(step.calibration.sensor.finger)
    grid = calibrated_grid(settings, finger, step.calibration)
    noise = settings.tactile.noise / math.sqrt(min(map(len, step.loads.frames)))
    live = step.converter.live
    signed = np.stack([step.converter.pressure(each) for each in step.over])
    presses = Presses(signed, d, theta, noise, live & ~step.saturated)
    material = make_material(settings.material)
    fits = compare_tips(presses, settings.tip.radius, grid, live, material)
    if not fits:
        raise CalibrationError(
            "law: found a modulus of at most 0 for each tip model, expected forces that increase "
            "with d; check the presses and their d"
        )
    best = fits[0]
    lines = [_told(best)]
    softer = first_cycle(d, theta, signed.sum(axis=(1, 2)))
    if softer is not None:
        lines.append(
            f"the readings of the first presses differ by {softer:+.1%} from the readings of later "
            "presses of equal depth"
        )
        if softer > _SOFTENS:
            lines[-1] += (
                ": the rubber softens; press the tip several times to the full depth, then "
                "calibrate again"
            )
    if best.trend is not None:
        lines.append(_over_d(best.trend))
    lines += [_told(each) for each in fits[1:]]
    if not covers(Fingertip(settings.tip.radius, "solid"), d, theta).all():
        lines.append("solid: not compared: a press exceeds the depth or tilt range of the data")
    steps: dict[str, Any] = {"scales": None, "law": None}
    wants = tip_settings(best.tip)
    if best.valid > 0.0:
        strain = [] if best.law.is_linear else np.linspace(0.05, 1.0, 20).tolist()
        stress = [float(best.material.stress(each)) for each in strain]
        steps["modulus"] = _kept(
            ModulusStep, best, strain=strain, stress=stress, residual=best.force_error
        )
    try:
        steps["law"], left = _measured(step, signed)
        d_error, theta_error = left[:2]
        lines.append(_measured_told(steps["law"], left))
        if best.valid < 1.0 or (d_error < 0.5 * best.d_error and theta_error < best.theta_error):
            wants = {"physics": "measured"}
    except CalibrationError as error:
        if best.valid == 0.0:
            raise CalibrationError(
                f"law: no model fits these presses; best model: {lines[0]}; measured curves: "
                f"{error}"
            ) from None
        lines.append(f"measured: could not fit curves: {error}")
    told = (f"tip.{name} = {json.dumps(value)}" for name, value in wants.items())
    lines.append(f"for the profile: {', '.join(told)}")
    return step.result(**steps, wants=wants), "\n  ".join(lines), ()


def _measured(step: Step, pressures: FloatArray) -> tuple[TipCurves, FloatArray]:
    """Fit the tip's measured curves to the loads with the mean ``pressures`` [n, rows, cols] [Pa].

    Returns the curves, and the RMS residuals of d [m], θ [rad] and F. The residual of F is relative
    to the RMS of F. Each load contributes the mean over its frames. Raises CalibrationError.
    """
    d, theta, converter, tare = step.d, step.theta, step.converter, step.calibration.tare
    if step.saturated.any():
        raise CalibrationError(
            "a cell saturated during a press, so the press can't be used; reduce the load"
        )
    seen = [converter(each) for each in step.loads.frames]
    rest = converter.pressure((tare.excess if tare else 0.0) * converter.gain)
    force, gain = pressures.sum(axis=(1, 2)) * step.cell_area, 1.0
    if (known := step.loads.truths.get("force")) is not None:
        gain = float(known @ force / (force @ force))
    radius = step.settings.tip.radius
    presses = PressSums(d, theta, seen, pressures, rest, converter.live, gain)
    law = fit_measured(presses, radius, step.plain_grid)
    placed = replace(step.plain_grid, centre=law.centre, rotation=law.rotation)
    estimator = MeasuredEstimator(Fingertip(radius, "measured", law=law), placed, converter.live)
    errors = []
    for k in np.flatnonzero(d > 0.0):
        found = [estimator(frame) for frame in seen[k]]
        depth, tilt = (np.array([getattr(e, name) for e in found]) for name in ("d", "tilt_x"))
        f = law.at(law.push, depth, tilt) * np.cos(tilt) - gain * force[k]
        errors.append([np.mean(depth) - d[k], np.mean(tilt) - theta[k], np.mean(f)])
    left = np.sqrt(np.mean(np.square(errors), axis=0))
    return law, left / (1.0, 1.0, gain * np.sqrt(np.mean(force[d > 0.0] ** 2)))


def _measured_told(law: TipCurves, left: FloatArray) -> str:
    d, theta, force = left.tolist()
    return (
        f"measured: curves from {law.presses} presses up to {law.deepest * 1e3:g} mm and "
        f"{math.degrees(law.tilt):g}°; remaining errors: d {d * 1e3:.3f} mm, θ "
        f"{math.degrees(theta):.2f}°, F {force:.1%}"
    )


def _over_d(trend: Trend) -> str:
    """Format E at the minimum, middle and maximum d, and append a warning if E drifts."""
    order = np.argsort(trend.d, kind="stable")[[0, len(trend.d) // 2, -1]]
    values = ", ".join(f"{each / 1e6:.3f}" for each in trend.modulus[order])
    depths = ", ".join(f"{each * 1e3:g}" for each in trend.d[order])
    told = f"E fitted separately at {depths} mm: {values} MPa"
    if not trend.drifts:
        return told
    return f"{told}: drifts by {trend.drift:+.0%} ± {trend.std:.1%}, so {trend.cause}"


def _told(fit: TipFit) -> str:
    words = (
        f"{tip_name(fit.tip, fit.law)}: E = {fit.modulus / 1e6:.4f} MPa, zero offset of d "
        f"{fit.offset * 1e3:.3f} mm, χ² {fit.chi2:.2f} per cell; "
    )
    if fit.valid == 0.0:
        return words + "all frames are invalid"
    return words + (
        f"remaining errors: d {fit.d_error * 1e3:.3f} mm, θ {math.degrees(fit.theta_error):.2f}°, "
        f"F {fit.force_error:.1%}, {fit.valid:.0%} of the frames are valid"
    )


def _relaxation(step: Step) -> Done:
    if (count := len(step.loads.frames)) > 1:
        raise CalibrationError(f"relaxation: found {count} presses, expected one")
    frames, t = step.loads.frames[0], step.loads.t[0] - step.loads.t[0][0]
    force = np.array([step.converter(frame).sum() for frame in frames]) * step.cell_area
    found = fit_relaxation(t, force, step.settings.tip.relaxation_times)
    strengths = ", ".join(f"{each:.3f}" for each in found.strengths)
    line = (
        f"force error {found.residual:.2%} rms, {found.elastic:.2%} for an elastic tip; for the "
        f"profile: tip.relaxation = [{strengths}]"
    )
    shown = Points("hold", "t [s]", "F [N]", t, force, found.model)
    left = Points("residuals", "t [s]", "measured − fit [N]", t, force - found.model)
    return step.calibration, line, (shown, left)


_STEPS = {
    "relaxation": _relaxation,
    "tare": _tare,
    "equilibrate": _equilibrate,
    "curve": _curve,
    "centre": _centre,
    "modulus": _modulus,
    "law": _law,
}
