"""Look up whether the simulated hand can hold an object of a given size, friction and mass.

`softfinger envelope --keep` creates a map of the objects that the hand can hold. The `grasp`
command uses the map to warn about grasps that may fail. A map is valid only for the hand that was
simulated. The packaged map was computed for the built-in hand.
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
    HELD: "the object is held",
    TURNED: "the object is held, but rotates by more than 5°",
    LOST: "the object slips out",
    REFUSED: "the hand can't grip the object",
}
GRAVITY = 9.81  # m/s²
_SECTIONS = ("hand", "tip", "material")


def identity(settings: Settings) -> dict[str, Any]:
    """Return the settings that determine whether a map is valid for a hand."""
    identifying = {name: getattr(settings, name).model_dump(mode="json") for name in _SECTIONS}
    return identifying | {"control": {"law": settings.control.law}}


def increased_force_limit(settings: Settings, force: float) -> float:
    """Return the highest force [N] to which the slip monitor can increase ``force`` [N]."""
    control, force_max = settings.control, GRIP_FRACTION * settings.safety.force_max
    increase = min(control.grip_raise_max, control.grip_raise_share * force)
    return max(min(force + increase, force_max), force)


def _difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Describe the first setting in which the map and the hand differ; return "" if they agree.

    If an old map lacks a setting, the setting's default is used.
    """
    defaults = identity(Settings())
    for name, section in expected.items():
        for key, value in section.items():
            if (other := found[name].get(key, defaults[name][key])) != value:
                return f"{name}.{key}: found {other}, expected {value}"
    return ""


class Envelope:
    """Map of simulated grasps for the object size and the tip friction in the settings."""

    def __init__(self, settings: Settings) -> None:
        """Read the map named in the settings.

        If the settings do not name a map, read the packaged map. The packaged map is used only if
        it is valid for this hand.

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
            # Each string contains the outcomes for one object mass, with one character per shape.
            rows = zip(*(found[shape][row : row + count] for shape in found["shapes"]), strict=True)
            self._outcomes = ["".join(cells[column] for cells in shapes) for shapes in rows]
            self._force_limit = found["raised"]
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            raise SettingsError(
                f"control.envelope: {own}: can't be read: {error!r}; create a map with "
                "`softfinger envelope --keep`"
            ) from None
        if own and other:
            raise SettingsError(
                f"control.envelope: {own}: the map belongs to another hand: {other}"
            )
        self._is_valid = not other
        self._settings = settings

    def warning(self, force: float) -> str:
        """Return a warning if a grasp with ``force`` [N] may fail; otherwise, return "".

        The map contains several object sizes. The lookup uses the size nearest to `object.width`.
        The map also contains several friction coefficients. The lookup uses the highest coefficient
        up to `control.tip_friction`. The mass is calculated from `control.object_load`. The mass is
        then scaled by the ratio (force limit in the map)/(force limit of this grip).
        """
        if not self._is_valid:
            return ""
        settings, control = self._settings, self._settings.control
        mass = control.object_load / GRAVITY
        scaled = mass * self._force_limit / increased_force_limit(settings, force)
        heavier = min(bisect_left(self._masses, scaled), len(self._masses) - 1)
        outcome = self._outcomes[heavier]
        if HELD in outcome or TURNED in outcome:
            return ""
        return (
            "this grip is outside the simulated envelope of this hand: with object.width = "
            f"{1e3 * settings.object.width:g} mm, control.tip_friction = {control.tip_friction:g}, "
            f"a mass of {mass:.2g} kg (control.object_load) and a force of {force:g} N, "
            f"{OUTCOME_TEXTS[outcome[0]]}; see docs/envelope.md"
        )
