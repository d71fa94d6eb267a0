"""From settings to the objects of `kinematics` that they describe, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.perception.calibration_file import Calibration, Converter, calibration_for
from softfinger.daemon.profile.settings import MaterialLaw, Settings
from softfinger.daemon.profile.table_files import load_or_build
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


@dataclass(frozen=True)
class FingerModel:
    """What one finger's frames and contacts are understood by, from settings and calibration.

    Estimator, table and prediction share it. ``calibration`` is None where there is none.
    """

    finger: int
    material: Material
    table: ContactTable
    grid: SensorGrid
    calibration: Calibration | None = None

    @property
    def own_material(self) -> bool:
        """The tip's law was measured, and is not the settings'."""
        return self.calibration is not None and self.calibration.modulus is not None


def make_models(
    settings: Settings, cache: Path | None, on_event: Callable[[str, str, str], None] | None = None
) -> tuple[FingerModel, FingerModel]:
    """Both fingers' models; a finger whose tip's modulus is not calibrated has the settings' law.

    A finger that takes no part, or has no sensor, goes by the settings alone. Raises as
    :func:`make_table` and `perception.calibration_file.calibration_for`.
    """
    made: list[FingerModel] = []
    common: tuple[Material, ContactTable] | None = None
    for finger, name in enumerate(FINGERS):
        calibration = None
        if name in settings.scene.fingers and settings.tactile.backend != "none":
            calibration = calibration_for(settings, finger)
        if calibration is not None and calibration.modulus is not None:
            material = calibration.modulus.material()
            table = make_table(settings, material, cache, on_event)
        else:
            if common is None:
                law = make_material(settings.material)
                common = law, make_table(settings, law, cache, on_event)
            material, table = common
        grid = make_grid(settings, finger, calibration)
        made.append(FingerModel(finger, material, table, grid, calibration))
        if calibration is not None and on_event is not None:
            on_event("info", "calibration", f"{name}: {calibration.summary()}")
    return made[0], made[1]


def make_tip(settings: Settings) -> Fingertip:
    """The fingertip."""
    return Fingertip(radius=settings.tip.radius)


def make_material(law: MaterialLaw) -> Material:
    """The settings' stress-strain law. Raises SettingsError when the points are no such law."""
    if law.law == "constant":
        return Material.constant(law.modulus)
    if law.law == "table_i":
        return Material.table_i()
    try:
        return Material.from_points(np.array(law.strain), np.array(law.stress))
    except ValueError as error:
        raise SettingsError(f"material.strain, material.stress: {error}") from None


def make_table(
    settings: Settings,
    material: Material,
    cache: Path | None,
    on_event: Callable[[str, str, str], None] | None = None,
) -> ContactTable:
    """The contact table, from its file in ``cache`` where one fits.

    What is wrong with that file is told to ``on_event``. Raises SettingsError when no table of this
    material reaches the tolerance.
    """
    tip = make_tip(settings)
    tolerance = settings.table.tolerance
    warn = None if on_event is None else partial(on_event, "warning", "table")
    try:
        if cache is None:
            return ContactTable.build(tip, material, tolerance=tolerance)
        return load_or_build(cache, tip, material, tolerance, warn)
    except TableError as error:
        raise SettingsError(f"table.tolerance: {error}") from None


def make_grid(
    settings: Settings, finger: int = 0, calibration: Calibration | None = None
) -> SensorGrid:
    """The sensor's cells under one finger, where the calibration says if there is one.

    Raises SettingsError for a blur wider than half the sensor.
    """
    tactile = settings.tactile
    centre, rotation = tactile.centre, tactile.rotation[finger]
    if calibration is not None and calibration.centre is not None:
        centre = calibration.centre.centre
        if calibration.centre.rotation is not None:
            rotation = calibration.centre.rotation
    try:
        return SensorGrid(
            rows=tactile.rows,
            cols=tactile.cols,
            pitch=(tactile.pitch, tactile.pitch_y or tactile.pitch),
            centre=centre,
            rotation=rotation,
            blur=tactile.blur,
        )
    except ValueError as error:
        raise SettingsError(f"tactile.blur: {error}") from None


def live_cells(settings: Settings, finger: int) -> NDArray[np.bool_]:
    """The cells that the settings don't call dead, bool [rows, cols]."""
    live = np.ones((settings.tactile.rows, settings.tactile.cols), np.bool_)
    for row, col in settings.tactile.dead[finger]:
        live[row, col] = False
    return live


def make_estimator(
    settings: Settings,
    material: Material,
    finger: int = 0,
    live: NDArray[np.bool_] | None = None,
    calibration: Calibration | None = None,
) -> ContactEstimator:
    """An estimator of its own for each finger, since it starts from its last estimate.

    ``live`` tells the cells that there are, beside the settings' dead ones. With a ``calibration``
    its frames are the pressures [Pa] of a :class:`Converter`, without one they are counts.
    """
    tactile = settings.tactile
    alive = live_cells(settings, finger)
    alive = alive if live is None else alive & live
    saturation, threshold, quantum = float(tactile.full_count), float(tactile.threshold), 0.0
    if calibration is not None:
        converter = Converter(calibration, tactile.pascal_per_count)
        alive = alive & converter.live
        saturation, quantum = converter.saturation, converter.quantum
        # The estimator takes half a count off a threshold, in the frame's unit.
        threshold = quantum * max(threshold - 0.5, 0.0) + 0.5 if threshold else 0.0
    return ContactEstimator(
        make_tip(settings),
        material,
        make_grid(settings, finger, calibration),
        noise=settings.tactile.noise,
        method=settings.estimator.method,
        free_gain=settings.estimator.free_gain,
        live=alive,
        saturation=saturation,
        threshold=threshold,
        quantum=quantum,
    )
