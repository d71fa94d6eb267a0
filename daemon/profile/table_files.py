"""Contact tables kept in files, so that a start does not build them again.

A file is written beside its place and moved there, so that it appears whole or not at all. One
that is damaged or can't be read is replaced; where no file can be kept, the table is built anyway.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from softfinger.daemon.own_files import write_whole
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable, table_key


def table_file(folder: Path, tip: Fingertip, material: Material, tolerance: float) -> Path:
    """Where in ``folder`` the table of this tip, material, tolerance and version is kept."""
    return folder / f"contact-{table_key(tip, material, tolerance).hex()[:16]}.table"


def save_table(file: Path, table: ContactTable, tip: Fingertip, material: Material) -> None:
    """Write ``file``, making its folder. Raises OSError where that is not possible."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, table.to_bytes(tip, material))


def load_table(file: Path, tip: Fingertip, material: Material, tolerance: float) -> ContactTable:
    """Read ``file``. Raises OSError, or TableError when it holds no sound table of this kind."""
    try:
        return ContactTable.from_bytes(file.read_bytes(), tip, material, tolerance)
    except TableError as error:
        raise TableError(f"{file}: {error}") from None


def load_or_build(
    folder: Path,
    tip: Fingertip,
    material: Material,
    tolerance: float,
    warn: Callable[[str], None],
) -> ContactTable:
    """The table kept in ``folder``, or built and kept there.

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
