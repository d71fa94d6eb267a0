"""Create the objects that the settings describe: tip, material, contact table and sensor grid."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import MaterialSettings, Settings
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.contact.table_record import TableError
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


def make_tip(settings: Settings) -> Fingertip:
    """Create the fingertip model. Raises SettingsError for a measured tip, which has no model."""
    tip = settings.tip
    if tip.physics == "measured":
        raise SettingsError('tip.physics: found "measured", expected "springs" or "solid"')
    return Fingertip(tip.radius, tip.physics, tip.poisson, tip.base, tip.face)


def law_problem(material: Material, limit: float) -> str:
    """Describe a law's fit error, or return "" if the force error is at most ``limit``."""
    found = material.worst_force_error
    if found <= limit:
        return ""
    return (
        "the material law deviates from the measured points by up to "
        f"{material.fit_error:.4g} Pa, which changes the force by up to {found:.1%}; expected at "
        f"most {limit:.1%} (material.force_error_max)"
    )


def make_material(law: MaterialSettings) -> Material:
    """Create the stress-strain law. Raises SettingsError if the law's points are unusable."""
    if law.law == "constant":
        return Material.constant(law.modulus)
    if law.law == "table_i":
        return Material.table_i()
    try:
        return Material.from_points(np.array(law.strain), np.array(law.stress))
    except ValueError as error:
        raise SettingsError(f"material.strain, material.stress: {error}") from None


def make_table(
    settings: Settings, material: Material | None = None, tip: Fingertip | None = None
) -> ContactTable:
    """Create the contact table for ``material`` and ``tip``, by default those in the settings.

    Raises SettingsError if the tolerance cannot be reached with this material.
    """
    material, tip = material or make_material(settings.material), tip or make_tip(settings)
    try:
        # Only tables of spring tips are cached. Other tables are fast to build.
        if tip.physics != "springs":
            return ContactTable.build(tip, material)
        return _built(tip, material, settings.table.tolerance)
    except TableError as error:
        raise SettingsError(f"table.tolerance: {error}") from None


@lru_cache(maxsize=8)
def _built(tip: Fingertip, material: Material, tolerance: float) -> ContactTable:
    """Build a contact table in about 0.16 s. All hands in one process share the table."""
    return ContactTable.build(tip, material, tolerance)


def make_grid(
    settings: Settings,
    finger: int = 0,
    centre: tuple[float, float] | None = None,
    rotation: float | None = None,
) -> SensorGrid:
    """Create the sensor grid for one finger.

    Measured values of ``centre`` [m] and ``rotation`` [rad] replace the values in the settings.
    """
    tactile = settings.tactile
    return SensorGrid(
        rows=tactile.rows,
        cols=tactile.cols,
        pitch=tactile.pitches,
        centre=tactile.centre if centre is None else centre,
        rotation=tactile.rotation[finger] if rotation is None else rotation,
        blur=tactile.blur,
    )
