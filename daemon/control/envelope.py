"""What the hand is known to hold: a map over shape, size, friction and mass, found by simulation.

`softfinger envelope` makes it; `grasp` asks it for a warning. It holds for the hand it was made for
and tells of others nothing.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from softfinger.daemon.profile.settings import Settings

KEPT = Path(__file__).with_name("envelope.toml")
HELD, TURNED, LOST, REFUSED = "htlr"
MEANING = {
    HELD: "held",
    TURNED: "held, but turned by more than 5°",
    LOST: "slips out",
    REFUSED: "no grip comes about",
}
_GRAVITY = 9.81  # m/s²
_SECTIONS = ("hand", "tip", "material")


def identity(settings: Settings) -> dict[str, Any]:
    """What of the settings a map belongs to."""
    told = {name: getattr(settings, name).model_dump(mode="json") for name in _SECTIONS}
    return told | {"law": settings.control.law}


class Envelope:
    """The packaged map, for one hand's settings."""

    def __init__(self, settings: Settings, path: Path = KEPT) -> None:
        """Read it once; for another hand than the map's, nothing is known."""
        self._map = tomllib.loads(path.read_text(encoding="utf-8"))
        self._known = self._map["identity"] == identity(settings)
        self._settings = settings

    def warning(self, force: float) -> str:
        """Why a grasp with so many N may fail, by what the settings say of the object, or nothing.

        Taken are the nearest size, friction that is no more than `control.tip_friction`, and the
        mass whose weight is `control.object_load`, scaled to the map's force.
        """
        if not self._known:
            return ""
        found, control, width = self._map, self._settings.control, self._settings.object.width
        mass = control.object_load / _GRAVITY
        column = min(range(len(found["size"])), key=lambda k: abs(found["size"][k] - width))
        friction = max(
            (k for k, each in enumerate(found["friction"]) if each <= control.tip_friction + 1e-9),
            default=0,
        )
        scaled = mass * found["force"] / force
        masses = found["mass"]
        heavier = next((k for k, each in enumerate(masses) if each >= scaled), len(masses) - 1)
        cells = {
            shape: found[shape][friction * len(masses) + heavier][column]
            for shape in found["shapes"]
        }
        failing = {shape: cell for shape, cell in cells.items() if cell in (LOST, REFUSED)}
        if len(failing) < len(cells):
            return ""
        reason = MEANING[next(iter(failing.values()))]
        return (
            f"outside of what this hand holds in simulation: {1e3 * width:g} mm (object.width) at "
            f"friction {control.tip_friction:g} (control.tip_friction) and {mass:.2g} kg "
            f"(control.object_load) with {force:g} N: {reason}; see docs/envelope.md"
        )
