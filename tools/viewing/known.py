"""The hand by its settings, from ``hand/settings``.

Keys of another version that can't be read keep their defaults, so that the rest is shown.
"""

from __future__ import annotations

import json
from typing import Any

from pydantic import ValidationError

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.hand.geometry import HandGeometry
from softfinger.tools.viewing.landscape import Landscape

_TOLERANCE = 1e-6  # relative error of a table for a picture


class ShownHand:
    """Its fingers, geometry and energy landscape."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        scene = self.settings.scene
        self.fingers = tuple(name for name in FINGERS if name in scene.fingers)
        self.servos = self.settings.servos.backend != "none"
        self.sensors = self.settings.tactile.backend != "none"
        lengths = self.settings.hand
        self.geometry = HandGeometry(
            lengths.pivot_separation,
            lengths.finger_length,
            lengths.finger_offset,
            self.settings.tip.radius,
        )

    def landscape(self) -> Landscape | None:
        """The energy landscape of the settings' material; None where no table can be made of it."""
        try:
            material, tip = make_material(self.settings.material), make_tip(self.settings)
            table = ContactTable.build(tip, material, tolerance=_TOLERANCE)
        except (SettingsError, TableError):
            return None
        return Landscape(table, tip.radius, self.settings.safety.d_max)


def warm_up() -> None:
    """Do what takes long the first time, before messages wait for it."""
    landscape = ShownHand().landscape()
    if landscape is not None:
        landscape.picture()
        landscape.contours()


def read_settings(message: dict[str, Any]) -> tuple[Settings, list[str]]:
    """A ``hand/settings``, and the keys in it that could not be read."""
    try:
        sections = json.loads(message.get("settings") or "{}")
    except (TypeError, ValueError):
        return Settings(), ["all of them"]
    passed: list[str] = []
    for _ in range(100):
        try:
            return Settings.model_validate_json(json.dumps(sections)), passed
        except ValidationError as error:
            place = [str(key) for key in error.errors()[0]["loc"][:2]]
            passed.append(".".join(place) or "all of them")
            if not _drop(sections, place):
                break
    return Settings(), passed


def _drop(sections: object, place: list[str]) -> bool:
    """Take the key at ``place`` (section, key) out; False where there is none."""
    for section in place[:-1]:
        sections = sections.get(section) if isinstance(sections, dict) else None
    return isinstance(sections, dict) and sections.pop(place[-1] if place else "", None) is not None
