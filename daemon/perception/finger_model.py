"""Build models of the fingertips and sensors from the settings and the calibration files."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.perception.calibration_file import Calibration, Converter, calibration_for
from softfinger.daemon.perception.prior import CALIBRATED_ERROR, MODULUS_ERROR, Prior
from softfinger.daemon.profile.factory import (
    law_problem,
    make_grid,
    make_material,
    make_table,
    make_tip,
)
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.validation import plausibility_warnings
from softfinger.daemon.types import FINGERS, EventSink
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimator, Readings
from softfinger.kinematics.estimation.measured import MeasuredEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


@dataclass(frozen=True)
class FingerModel:
    """Material, contact table, sensor grid and optional calibration of one finger."""

    finger: int
    material: Material
    table: ContactTable
    grid: SensorGrid
    calibration: Calibration | None
    prior: Prior


def make_models(
    settings: Settings, on_event: EventSink | None = None
) -> tuple[FingerModel, FingerModel]:
    """Create the models of both fingers.

    If the modulus of a tip is not calibrated, the stress-strain law comes from the settings. A
    calibration file is read only for a finger that is in the scene and has a sensor.

    Raises the same exceptions as `profile.factory.make_table` and
    `calibration_file.calibration_for`.
    """
    if on_event is not None:
        for warning in plausibility_warnings(settings):
            on_event("warning", "settings", warning)
    measured = settings.tip.physics == "measured"
    made: dict[int, FingerModel] = {}
    common: tuple[Material, ContactTable] | None = None
    for finger, name in enumerate(FINGERS):
        calibration = None
        if name in settings.scene.fingers and settings.tactile.backend != "none":
            calibration = calibration_for(settings, finger)
        if measured:
            if name not in settings.scene.fingers:
                continue  # The model of the other finger is copied below.
            material, tip = Material.constant(1.0), _measured_tip(settings, finger, calibration)
            table = make_table(settings, material, tip)
        elif calibration is not None and calibration.modulus is not None:
            material = calibration.modulus.material()
            problem = law_problem(material, settings.material.force_error_max)
            if problem:
                raise SettingsError(f"{settings.tactile.calibration[finger]}: modulus: {problem}")
            table = make_table(settings, material)
        else:
            if common is None:
                law = make_material(settings.material)
                common = law, make_table(settings, law)
            material, table = common
        grid = calibrated_grid(settings, finger, calibration)
        prior = make_prior(settings, calibration)
        made[finger] = FingerModel(finger, material, table, grid, calibration, prior)
        if calibration is not None and on_event is not None:
            on_event("info", "calibration", f"{name}: {calibration.summary()}")
        if material.misfits is not None and on_event is not None:
            text = (
                f"{name}: the material law deviates from the measured points by up to "
                f"{material.fit_error:.0f} Pa, which changes the force by up to "
                f"{material.worst_force_error:.1%}"
            )
            on_event("info", "material", text)
    left, right = (made.get(k) or replace(made[1 - k], finger=k) for k in range(len(FINGERS)))
    return left, right


def make_prior(settings: Settings, calibration: Calibration | None) -> Prior:
    """Return a finger's prior, either from a run of `calibrate scales` or from the settings."""
    if calibration is not None and calibration.scales is not None:
        found = calibration.scales
        # The gain varies with temperature and load, so its prior is never more precise than the
        # error in the settings.
        gain = found.gain[0], max(found.gain[1], settings.tactile.gain_error)
        return Prior(found.modulus, gain, found.torque)
    error = settings.material.modulus_error or MODULUS_ERROR
    if settings.tip.physics == "measured":
        error = CALIBRATED_ERROR
    elif calibration is not None and calibration.modulus is not None:
        error = max(CALIBRATED_ERROR, calibration.modulus.residual)
    torque = settings.control.torque_error
    return Prior((1.0, error), (1.0, settings.tactile.gain_error), (1.0, torque))


def _measured_tip(settings: Settings, finger: int, calibration: Calibration | None) -> Fingertip:
    """Return the tip with the measured curves from its calibration file.

    Raises SettingsError if the file has no curves or if the curves do not match the settings.
    """
    law = None if calibration is None else calibration.law
    file = settings.tactile.calibration[finger]
    if law is None:
        raise SettingsError(
            f'tip.physics: found "measured", but {file or "tactile.calibration"} does not contain '
            f"curves for the {FINGERS[finger]} tip; run `softfinger calibrate law` to measure them"
        )
    if law.radius != settings.tip.radius:
        raise SettingsError(
            f"tip.radius: found {settings.tip.radius:g} m, expected {law.radius:g} m as in {file}"
        )
    if settings.safety.d_max > law.deepest:
        raise SettingsError(
            f"safety.d_max: found {settings.safety.d_max:g} m, expected at most {law.deepest:g} "
            f"m, the maximum depth in {file}"
        )
    return Fingertip(law.radius, "measured", law=law)


def calibrated_grid(settings: Settings, finger: int, calibration: Calibration | None) -> SensorGrid:
    """Return a sensor's grid; use the calibrated centre and rotation if they are available."""
    if settings.tip.physics == "measured" and calibration is not None and calibration.law:
        return make_grid(settings, finger, calibration.law.centre, calibration.law.rotation)
    if calibration is None or calibration.centre is None:
        return make_grid(settings, finger)
    return make_grid(settings, finger, calibration.centre.centre, calibration.centre.rotation)


def working_cells(
    settings: Settings,
    finger: int,
    active: NDArray[np.bool_] | None = None,
    calibration: Calibration | None = None,
) -> NDArray[np.bool_]:
    """Return a mask [rows, cols] of the cells that are ``active`` and not dead.

    Dead cells are listed in the settings, or have a gain of 0 in the calibration.
    """
    tactile = settings.tactile
    alive = np.ones((tactile.rows, tactile.cols), np.bool_) if active is None else active.copy()
    for row, col in tactile.dead[finger]:
        alive[row, col] = False
    if calibration is not None and calibration.equilibrate is not None:
        alive &= np.array(calibration.equilibrate.gain) > 0.0
    return alive


def make_estimator(
    settings: Settings,
    material: Material,
    finger: int = 0,
    active: NDArray[np.bool_] | None = None,
    calibration: Calibration | None = None,
) -> ContactEstimator | MeasuredEstimator:
    """Create a finger's estimator.

    Each finger needs its own estimator, because an estimator stores its last estimate.

    Parameters
    ----------
    settings, material, finger
        Settings for the hand, material of the tip, and index of the finger.
    active
        True for cells that exist [rows, cols]. Dead cells are also excluded; see `working_cells`.
    calibration
        With a calibration, frames are pressures [Pa] from a `Converter`; otherwise, frames are
        counts.
    """
    tactile = settings.tactile
    alive = working_cells(settings, finger, active, calibration)
    saturation, threshold, quantum = float(tactile.full_count), float(tactile.threshold), 0.0
    if calibration is not None:
        converter = Converter(calibration, tactile.pascal_per_count, tactile.full_count)
        converter.live = alive
        saturation, quantum = converter.saturation, converter.quantum
        # The estimator itself subtracts half a frame unit from the threshold.
        threshold = quantum * max(threshold - 0.5, 0.0) + 0.5 if threshold else 0.0
    if settings.tip.physics == "measured":
        return MeasuredEstimator(
            _measured_tip(settings, finger, calibration),
            calibrated_grid(settings, finger, calibration),
            alive,
            uncertainty(settings, calibration),
        )
    free_gain = settings.estimator.free_gain
    return ContactEstimator(
        make_tip(settings),
        material,
        calibrated_grid(settings, finger, calibration),
        noise=tactile.noise,
        free_gain=None if free_gain == "auto" else free_gain,
        active=alive,
        readings=Readings(saturation, threshold, quantum),
        known=uncertainty(settings, calibration),
    )


def uncertainty(settings: Settings, calibration: Calibration | None) -> Uncertainty:
    """Return the systematic uncertainties from the settings, updated with the calibration."""
    tactile = settings.tactile
    baseline, centre, pitch = tactile.baseline_error, tactile.centre_error, tactile.pitch_error
    modulus, correlation = settings.material.modulus_error, None
    if calibration is not None:
        tare, place = calibration.tare, calibration.centre
        if tare is not None and tare.correlation:
            correlation = np.array(tare.correlation)
        if tare is not None and tare.drift > 0.0:
            quantum = Converter(calibration, tactile.pascal_per_count).quantum
            baseline = math.hypot(baseline, tare.drift * quantum)
        if place is not None and place.std > 0.0:
            centre = place.std
            pitch = max(pitch, abs(place.scale - 1.0))
        if calibration.modulus is not None:
            modulus = max(modulus, calibration.modulus.residual)
    return Uncertainty(
        baseline,
        centre,
        pitch,
        modulus,
        correlation,
        slope=tactile.slope_error,
        gain=tactile.gain_error,
        smooth=tactile.smooth_error,
        rotation=tactile.rotation_error,
    )
