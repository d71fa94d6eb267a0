"""Map of the objects that the hand can hold, over shape, size, friction and mass, by simulation.

`softfinger envelope --keep` makes it, `grasp` asks it for a warning. It holds for the hand it was
made for; the packaged one is the built-in hand's, and tells of others nothing.
"""

from __future__ import annotations

import tomllib
from bisect import bisect_left
from pathlib import Path
from typing import Any

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.load import profile_text
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import GRIP_FRACTION

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
    """Return the settings that a map belongs to."""
    told = {name: getattr(settings, name).model_dump(mode="json") for name in _SECTIONS}
    return told | {"control": {"law": settings.control.law}}


def raised(settings: Settings, force: float) -> float:
    """Return the force [N] to which a grip of ``force`` [N] may be raised."""
    most = GRIP_FRACTION * settings.safety.force_max
    return max(min(force + settings.control.grip_raise_max, most), force)


def _difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """The first key of both sections that is not the same, with both values.

    A setting that came after the map was made had its default.
    """
    defaults = identity(Settings())
    for name, section in expected.items():
        for key, value in section.items():
            if (other := found[name].get(key, defaults[name][key])) != value:
                return f"{name}.{key}: found {other}, expected {value}"
    return ""


class Envelope:
    """A map of one hand, asked for the object that the settings name."""

    def __init__(self, settings: Settings) -> None:
        """Read the settings' own map, or the packaged one if it is this hand's.

        Raises SettingsError for a map that can't be read, or is another hand's.
        """
        own, control = settings.control.envelope, settings.control
        try:
            found = tomllib.loads(profile_text(Path(own or KEPT)))
            other = _difference(found["identity"], identity(settings))
            frictions, self._masses, sizes = found["friction"], found["mass"], found["size"]
            width, count = settings.object.width, len(self._masses)
            column = min(range(len(sizes)), key=lambda k: abs(sizes[k] - width))
            row = max(sum(each <= control.tip_friction + 1e-9 for each in frictions) - 1, 0) * count
            # Over the masses: what became of a block, of a disc.
            rows = zip(*(found[shape][row : row + count] for shape in found["shapes"]), strict=True)
            self._outcomes = ["".join(cells[column] for cells in shapes) for shapes in rows]
            self._raised = found["raised"]
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            raise SettingsError(
                f"control.envelope: {own}: no map of `softfinger envelope --keep`: {error!r}"
            ) from None
        if own and other:
            raise SettingsError(f"control.envelope: {own} is another hand's: {other}")
        self._known = not other
        self._settings = settings

    def warning(self, force: float) -> str:
        """Return why a grasp of so many N may fail with the settings' object; empty if not.

        Taken are the nearest size, friction that is no more than `control.tip_friction`, and the
        mass whose weight is `control.object_load`, scaled by what the grip may be raised to.
        """
        if not self._known:
            return ""
        settings, control = self._settings, self._settings.control
        mass = control.object_load / _GRAVITY
        scaled = mass * self._raised / raised(settings, force)
        heavier = min(bisect_left(self._masses, scaled), len(self._masses) - 1)
        outcome = self._outcomes[heavier]
        if HELD in outcome or TURNED in outcome:
            return ""
        return (
            f"outside of what this hand holds in simulation: {1e3 * settings.object.width:g} mm "
            f"(object.width) at friction {control.tip_friction:g} (control.tip_friction) and "
            f"{mass:.2g} kg (control.object_load) with {force:g} N: {MEANING[outcome[0]]}; "
            "see docs/envelope.md"
        )
