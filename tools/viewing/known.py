"""What the viewer knows of the hand beside its states: settings and what was commanded.

Settings come from ``hand/settings``. What this version can't read in them, since another wrote
them, is left at its default, so that the rest is shown.
"""

from __future__ import annotations

import json
import math
from typing import Any

from pydantic import ValidationError

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.lookup import TableError
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.hand.geometry import HandGeometry
from softfinger.tools.terminal.feed import number, text
from softfinger.tools.viewing.landscape import Landscape

_PICTURE = 1e-6  # relative error of a table that is only looked at
_GRIPPING = ("grasping", "holding", "rotating")


class Hand:
    """The hand by its settings: who takes part, its lengths, its landscape."""

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
            table = ContactTable.build(tip, material, tolerance=_PICTURE)
        except (SettingsError, TableError):
            return None
        return Landscape(table, tip.radius, self.settings.safety.d_max)


def warm_up() -> None:
    """What takes long when it is done first, before messages wait for it."""
    landscape = Hand().landscape()
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


class Wanted:
    """What the hand goes to: force [N] of the tips, angle [rad] of the object.

    What the state tells; where an older daemon's does not, what was last commanded. NaN while
    nothing is wanted.
    """

    def __init__(self) -> None:
        self._force = math.nan
        self._angle = math.nan

    def take(self, message: dict[str, Any], hand: Hand) -> None:
        """One more command that was answered."""
        if message.get("ok") is not True:
            return
        try:
            request = json.loads(message.get("request") or "{}")
        except (TypeError, ValueError):
            return
        command = text(message, "command")
        if command == "grasp":
            force = number(request, "force")
            self._force = force if math.isfinite(force) else hand.settings.control.force_default
            self._angle = math.nan
        elif command == "rotate":
            self._angle = number(request, "angle")
        elif command not in ("set", "tare", "status"):
            self._force = self._angle = math.nan

    def of(self, state: dict[str, Any]) -> tuple[float, float]:
        """The wanted force and angle at a state."""
        if "goal_force" in state:
            return number(state, "goal_force"), number(state, "goal_angle")
        if text(state, "mode") in _GRIPPING:
            return self._force, self._angle
        return math.nan, math.nan
