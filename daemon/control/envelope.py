"""Simulated map of the objects that the hand can hold, by shape, size, friction and mass.

`softfinger envelope --keep` creates it, and `grasp` uses it to warn. A map is valid only for the
hand that it was simulated for; the packaged map is valid for the built-in hand.
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

PACKAGED_MAP = Path(__file__).with_name("envelope.toml")
HELD, TURNED, LOST, REFUSED = "htlr"
OUTCOME_TEXTS = {
    HELD: "held",
    TURNED: "held, but turned by more than 5°",
    LOST: "slips out",
    REFUSED: "no grip comes about",
}
_GRAVITY = 9.81  # m/s²
_SECTIONS = ("hand", "tip", "material")


def identity(settings: Settings) -> dict[str, Any]:
    """Return the settings that identify the hand of a map."""
    identifying = {name: getattr(settings, name).model_dump(mode="json") for name in _SECTIONS}
    return identifying | {"control": {"law": settings.control.law}}


def increased_force_limit(settings: Settings, force: float) -> float:
    """Return the force [N] up to which the slip monitor may raise a grip of ``force`` [N]."""
    force_max = GRIP_FRACTION * settings.safety.force_max
    return max(min(force + settings.control.grip_raise_max, force_max), force)


def _difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Return the first setting that differs, with both values, or an empty text.

    A setting that an older map does not contain counts as its default.
    """
    defaults = identity(Settings())
    for name, section in expected.items():
        for key, value in section.items():
            if (other := found[name].get(key, defaults[name][key])) != value:
                return f"{name}.{key}: found {other}, expected {value}"
    return ""


class Envelope:
    """Map of one hand, evaluated for the object of the settings."""

    def __init__(self, settings: Settings) -> None:
        """Read the map that the settings name, or the packaged one if it fits this hand.

        Raises
        ------
        SettingsError
            If the map can't be read or belongs to another hand.
        """
        own, control = settings.control.envelope, settings.control
        try:
            found = tomllib.loads(profile_text(Path(own or PACKAGED_MAP)))
            other = _difference(found["identity"], identity(settings))
            frictions, self._masses, sizes = found["friction"], found["mass"], found["size"]
            width, count = settings.object.width, len(self._masses)
            column = min(range(len(sizes)), key=lambda k: abs(sizes[k] - width))
            row = max(sum(each <= control.tip_friction + 1e-9 for each in frictions) - 1, 0) * count
            # For each mass, the outcomes of a block and of a disc.
            rows = zip(*(found[shape][row : row + count] for shape in found["shapes"]), strict=True)
            self._outcomes = ["".join(cells[column] for cells in shapes) for shapes in rows]
            self._force_limit = found["raised"]
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            raise SettingsError(
                f"control.envelope: {own}: no map of `softfinger envelope --keep`: {error!r}"
            ) from None
        if own and other:
            raise SettingsError(f"control.envelope: {own} is another hand's: {other}")
        self._is_valid = not other
        self._settings = settings

    def warning(self, force: float) -> str:
        """Return a warning if a grasp of ``force`` [N] may fail, or an empty text.

        The lookup uses the nearest object size, the largest friction up to `control.tip_friction`,
        and the mass whose weight is `control.object_load`. The mass is scaled by the ratio of the
        force limit of the map to the force limit of this grip.
        """
        if not self._is_valid:
            return ""
        settings, control = self._settings, self._settings.control
        mass = control.object_load / _GRAVITY
        scaled = mass * self._force_limit / increased_force_limit(settings, force)
        heavier = min(bisect_left(self._masses, scaled), len(self._masses) - 1)
        outcome = self._outcomes[heavier]
        if HELD in outcome or TURNED in outcome:
            return ""
        return (
            f"outside of what this hand holds in simulation: {1e3 * settings.object.width:g} mm "
            f"(object.width) at friction {control.tip_friction:g} (control.tip_friction) and "
            f"{mass:.2g} kg (control.object_load) with {force:g} N: {OUTCOME_TEXTS[outcome[0]]}; "
            "see docs/envelope.md"
        )
