"""The hand by its settings, from ``hand/settings``, and its energy landscape U(d, θ) as a picture.

Keys of another version that can't be read keep their defaults, so that the rest is shown.

The picture has θ to the right and d upwards; its coordinates are pixels from the upper left corner,
as an image's are. Colour goes in steps with the cube root of U, which grows in proportion to d, so
that the valley along θ = 0 shows at every depth; the edge of a step is a line of equal energy.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import geometry_of
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.terminal import heatmap

FloatArray = NDArray[np.float64]

WIDTH, HEIGHT = 240, 200  # pixels
THETA_END = math.radians(45.0)  # the picture's, to both sides


class Landscape:
    """The landscape of one tip up to a displacement of ``d_end`` [m]."""

    def __init__(self, table: ContactTable, radius: float, d_end: float) -> None:
        self._table = table
        self.d_end = min(d_end, 0.95 * radius)
        self.highest = float(table(self.d_end, 0.0).energy)  # J, of the last colour

    def place(self, d: FloatArray | float, theta: FloatArray | float) -> FloatArray:
        """Pixels [..., 2] of displacements [m] and angles [rad]; NaN stays NaN."""
        x = (np.asarray(theta) / THETA_END + 1.0) * 0.5 * WIDTH
        y = (1.0 - np.asarray(d) / self.d_end) * HEIGHT
        return np.stack(np.broadcast_arrays(x, y), axis=-1)

    def picture(self) -> NDArray[np.uint8]:
        """Levels [HEIGHT, WIDTH] of `heatmap`'s colours, one more where no such contact can be."""
        theta = (2.0 * (np.arange(WIDTH) + 0.5) / WIDTH - 1.0) * THETA_END
        d = (1.0 - (np.arange(HEIGHT) + 0.5) / HEIGHT) * self.d_end
        depth, angle = np.meshgrid(d, theta, indexing="ij")
        contact = self._table(depth, angle, edge=True)
        levels = heatmap.levels_of(np.cbrt(np.asarray(contact.energy) / self.highest), 1.0)
        return np.where(contact.inside, levels, heatmap.LEVELS).astype(np.uint8)

    def ticks(self) -> list[tuple[FloatArray, str]]:
        """Return where the axes' numbers stand [2], and what they say."""
        ticks = []
        for degrees in (-40, -20, 0, 20, 40):
            x, y = self.place(0.0, math.radians(degrees))
            ticks.append((np.array([x, y + 9.0]), f"{degrees:+d}°" if degrees else "θ = 0°"))
        step = next((step for step in (1, 2, 5) if self.d_end <= 0.0065 * step), 10)
        for millimetres in range(0, int(1e3 * self.d_end) + 1, step):
            x, y = self.place(1e-3 * millimetres, -THETA_END)
            name = f"{millimetres} mm" if millimetres else "d = 0"
            ticks.append((np.array([x - 14.0, y]), name))
        return ticks


_TOLERANCE = 1e-6  # relative error of a table for a picture


class ShownHand:
    """Its fingers, geometry and energy landscape."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        scene = self.settings.scene
        self.fingers = tuple(name for name in FINGERS if name in scene.fingers)
        self.servos = self.settings.servos.backend != "none"
        self.sensors = self.settings.tactile.backend != "none"
        self.geometry = geometry_of(self.settings)

    def landscape(self) -> Landscape | None:
        """The energy landscape of the settings' material; None where no table can be made of it."""
        try:
            material, tip = make_material(self.settings.material), make_tip(self.settings)
            table = ContactTable.build(tip, material, tolerance=_TOLERANCE)
        except (SettingsError, TableError):
            return None
        return Landscape(table, tip.radius, self.settings.safety.d_max)


def read_settings(message: dict[str, Any]) -> tuple[Settings, list[str]]:
    """Return a ``hand/settings``, and the keys in it that could not be read."""
    try:
        sections = json.loads(message.get("settings") or "{}")
        return Settings.model_validate_json(json.dumps(sections)), []
    except ValidationError as error:
        places = [[str(key) for key in each["loc"][:2]] for each in error.errors()]
    except (TypeError, ValueError):
        return Settings(), ["all of them"]
    for *section, key in filter(None, places):
        (sections.get(section[0], {}) if section else sections).pop(key, None)
    try:
        passed = sorted({".".join(place) for place in places})
        return Settings.model_validate_json(json.dumps(sections)), passed
    except ValidationError:
        return Settings(), ["all of them"]
