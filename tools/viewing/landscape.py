"""Read the settings in ``hand/settings``, and draw the tip's energy landscape U(d, θ).

If a key cannot be read, for example because another version wrote the settings, the default value
is used.
"""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.contact.table_record import TableError
from softfinger.tools.terminal import heatmap

WIDTH, HEIGHT = 240, 200  # width and height of the landscape [pixels]
THETA_END = 45.0  # maximum |θ| [degrees]
_TOLERANCE = 1e-6  # relative tolerance of the contact table


class Landscape(NamedTuple):
    """A tip's energy, with θ on the horizontal axis and d on the vertical axis.

    The colour changes stepwise with the cube root of U. Because this root is proportional to d, the
    valley along θ = 0 is visible at every depth. The edges between colours are lines of constant
    energy.
    """

    # Levels of `heatmap` [HEIGHT, WIDTH]. The level `LEVELS` marks impossible contacts.
    levels: NDArray[np.uint8]
    d_end: float  # d at the upper edge [m]
    highest: float  # energy at the end of the colour scale [J]


def landscape(settings: Settings) -> Landscape | None:
    """Return the material's energy landscape, or None if the contact table cannot be built."""
    try:
        material, tip = make_material(settings.material), make_tip(settings)
        table = ContactTable.build(tip, material, tolerance=_TOLERANCE)
    except (SettingsError, TableError):
        return None
    d_end = min(settings.safety.d_max, 0.95 * tip.radius)
    highest = float(table(d_end, 0.0).energy)
    theta = math.radians(THETA_END) * (2.0 * (np.arange(WIDTH) + 0.5) / WIDTH - 1.0)
    d = d_end * (1.0 - (np.arange(HEIGHT) + 0.5) / HEIGHT)
    contact = table(*np.meshgrid(d, theta, indexing="ij"), edge=True)
    levels = heatmap.levels_of(np.cbrt(np.asarray(contact.energy) / highest), 1.0)
    levels = np.where(contact.inside, levels, heatmap.LEVELS)
    return Landscape(levels.astype(np.uint8), d_end, highest)


def read_settings(message: dict[str, Any]) -> tuple[Settings, list[str]]:
    """Read a ``hand/settings`` message; return the settings and the unreadable keys."""
    try:
        sections = json.loads(message.get("settings") or "{}")
        return Settings.model_validate_json(json.dumps(sections)), []
    except ValidationError as error:
        places = [[str(key) for key in each["loc"][:2]] for each in error.errors()]
    except (TypeError, ValueError, RecursionError):
        return Settings(), ["all of them"]
    for *section, key in filter(None, places):
        (sections.get(section[0], {}) if section else sections).pop(key, None)
    try:
        passed = sorted({".".join(place) for place in places})
        return Settings.model_validate_json(json.dumps(sections)), passed
    except ValidationError:
        return Settings(), ["all of them"]
