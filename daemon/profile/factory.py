"""Makes what settings describe: tip, material, contact table, sensor grid.

Contact tables are kept in files, so that a start does not build them again. One that is damaged or
can't be read is replaced; where no file can be kept, the table is built anyway.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import MaterialSettings, Settings
from softfinger.kinematics.compiled.own_folder import OwnFolder
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable, table_key
from softfinger.kinematics.sensing.pressure_grid import SensorGrid


def make_tip(settings: Settings) -> Fingertip:
    """Make the fingertip. Raises SettingsError for a measured one, which each finger has itself."""
    tip = settings.tip
    if tip.physics == "measured":
        raise SettingsError(
            'tip.physics: found "measured", expected "springs" or "solid" for what needs a model'
        )
    return Fingertip(tip.radius, tip.physics, tip.poisson, tip.base, tip.face)


def law_problem(material: Material, limit: float) -> str:
    """Return why a law off its points by over ``limit`` of F can't be used; empty if it can."""
    found = material.worst_force_error
    if found <= limit:
        return ""
    return (
        f"the smooth law misses its points by up to {material.fit_error:.4g} Pa, which makes "
        f"{found:.1%} of F; expected {limit:.1%} at most (material.force_error_max)"
    )


def make_material(law: MaterialSettings) -> Material:
    """Make the settings' stress-strain law. Raises SettingsError for points of no usable law."""
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
    tip: Fingertip | None = None,
) -> ContactTable:
    """Return contact table, from its file in ``cache`` where one fits; ``tip``: not the settings'.

    ``on_event`` takes a warning where that file can't be used. Raises SettingsError when no table
    of this material reaches the tolerance.
    """
    tip = tip or make_tip(settings)
    tolerance = settings.table.tolerance
    warn = warnings.warn if on_event is None else partial(on_event, "warning", "table")
    try:
        if tip.physics != "springs":  # which takes no time to make
            return ContactTable.build(tip, material)
        if cache is None:
            return _built(tip, material, tolerance)
        return load_or_build(cache, tip, material, tolerance, warn)
    except TableError as error:
        raise SettingsError(f"table.tolerance: {error}") from None


@lru_cache(maxsize=8)
def _built(tip: Fingertip, material: Material, tolerance: float) -> ContactTable:
    """The table without a file: 0.16 s of work that hands of one process share."""
    return ContactTable.build(tip, material, tolerance)


def make_grid(
    settings: Settings,
    finger: int = 0,
    centre: tuple[float, float] | None = None,
    rotation: float | None = None,
) -> SensorGrid:
    """Make the sensor's cells under one finger; ``centre`` [m], ``rotation`` [rad] if measured."""
    tactile = settings.tactile
    return SensorGrid(
        rows=tactile.rows,
        cols=tactile.cols,
        pitch=(tactile.pitch, tactile.pitch_y or tactile.pitch),
        centre=tactile.centre if centre is None else centre,
        rotation=tactile.rotation[finger] if rotation is None else rotation,
        blur=tactile.blur,
    )


def table_file(folder: Path, tip: Fingertip, material: Material, tolerance: float) -> Path:
    """Return where in ``folder`` the table of this tip, material, tolerance and version is kept."""
    return folder / f"contact-{table_key(tip, material, tolerance).hex()[:16]}.table"


def save_table(file: Path, table: ContactTable, tip: Fingertip, material: Material) -> None:
    """Write ``file``, making its folder. Raises OSError where that is not possible."""
    with OwnFolder(file.parent) as folder:
        folder.write(file.name, table.to_bytes(tip, material))


def load_table(file: Path, tip: Fingertip, material: Material, tolerance: float) -> ContactTable:
    """Read ``file``. Raises OSError, or TableError when it holds no sound table of this kind."""
    with OwnFolder(file.parent) as folder:
        data = folder.read(file.name)
    try:
        return ContactTable.from_bytes(data, tip, material, tolerance)
    except TableError as error:
        raise TableError(f"{file}: {error}") from None


def load_or_build(
    folder: Path,
    tip: Fingertip,
    material: Material,
    tolerance: float,
    warn: Callable[[str], None],
) -> ContactTable:
    """Return the table kept in ``folder``, or built and kept there.

    ``warn`` takes what is wrong with a file or the folder. Raises TableError when the tolerance
    can't be met.
    """
    file = table_file(folder, tip, material, tolerance)
    try:
        return load_table(file, tip, material, tolerance)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, TableError) as error:
        warn(f"the contact table is built again: {error}")
    table = ContactTable.build(tip, material, tolerance)
    try:
        save_table(file, table, tip, material)
    except OSError as error:
        warn(f"the contact table can't be kept, each start builds it again: {error}")
    return table
