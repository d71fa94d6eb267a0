"""Simulate a plate that a stage presses against a tip at a given depth, tilt and speed.

The tip's sensor measures the plate instead of the object. The true contact is known, so users can
try calibration without hardware. The plate is frictionless and does not load the finger joint, as
if the finger were clamped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.simulation.simulated_tactile import StageTouch
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.table import ContactTable

_CLEARANCE = 1e-3  # distance from the tip at which the plate tilts and waits [m]
_LIFT_SPEED = 0.02  # m/s
_FILL_TIME = 0.1  # time to inflate a bladder [s]
_PAUSE = 1.0  # pause without contact between presses [s]

_UNITS = {
    "depth": {"mm": 1e-3, "m": 1.0},
    "force": {"N": 1.0},
    "pressure": {"kPa": 1e3, "Pa": 1.0},
    "tilt": {"deg": math.pi / 180.0, "°": math.pi / 180.0, "rad": 1.0},
    "speed": {"mm/s": 1e-3, "m/s": 1.0},
    "hold": {"s": 1.0, "ms": 1e-3},
}
_LOADS = ("depth", "force", "pressure")
_NUMBER = re.compile(r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?)(.*)")


class PlateError(SoftfingerError, ValueError):
    """Invalid or impossible press. The error message states the expected format or range."""


@dataclass(frozen=True, slots=True)
class PlatePress:
    """One press of the plate, to the depth ``d`` [m] at the tilt ``theta`` [rad].

    A ``pressure`` [Pa] above 0 replaces the contact with a uniform pressure on all cells. ``force``
    [N] is the resulting force on the tip base. The press is held for ``hold`` [s]. If ``hold`` is
    infinite, the press lasts until the next command.
    """

    d: float
    theta: float
    pressure: float
    force: float
    speed: float
    hold: float

    @property
    def is_clear(self) -> bool:
        """True if this press lifts the plate off the tip."""
        return self.d <= 0.0 and self.pressure == 0.0 and self.hold == math.inf

    def __str__(self) -> str:
        if self.pressure > 0.0:
            return f"{self.pressure / 1e3:g} kPa on all cells"
        if self.d <= 0.0:
            return "the plate does not touch the tip"
        return f"{self.d * 1e3:.3f} mm at {math.degrees(self.theta):.2f}°, {self.force:.3f} N"


def parse_presses(text: str, table: ContactTable, scale: float) -> dict[str, list[PlatePress]]:
    """Parse comma-separated presses such as ``tip=left depth=4mm``, and group them by finger.

    Each press specifies a depth, a force, or a uniform pressure, as exerted by a bladder. A depth
    of 0 lifts the plate off. The words ``tilt=``, ``speed=``, ``hold=`` and ``tip=`` are optional.
    The tip is ``left``, ``right`` or, by default, ``both``. By default, the last press is held
    indefinitely, and each earlier press is held for one second. The forces in ``table`` are
    multiplied by ``scale``. Raises PlateError.
    """
    made: dict[str, list[PlatePress]] = {}
    each = [part.split() for part in text.split(",")]
    for k, words in enumerate(each):
        values = {"tilt": 0.0, "speed": 0.005, "hold": 1.0 if k < len(each) - 1 else math.inf}
        tip = "both"
        for word in words:
            name, _, value = word.partition("=")
            if name == "tip" and value in (*FINGERS, "both"):
                tip = value
            else:
                values[name] = _value(name, value)
        load = [name for name in _LOADS if name in values]
        if len(load) != 1:
            raise PlateError(
                f"press {' '.join(words)!r}: expected exactly one of {', '.join(_LOADS)}"
            )
        press = _press(values, table, scale)
        for finger in FINGERS if tip == "both" else (tip,):
            made.setdefault(finger, []).append(press)
    return made


def _value(name: str, text: str) -> float:
    units = _UNITS.get(name)
    if units is None:
        raise PlateError(f"press: found {name!r}, expected {', '.join(_UNITS)} or tip=left|right")
    match = _NUMBER.fullmatch(text)
    number, unit = match.groups() if match else ("nan", "")
    try:
        value = float(number) * units[unit]
    except (ValueError, KeyError):
        value = math.nan
    if not math.isfinite(value) or (name != "tilt" and value < 0.0):
        raise PlateError(f"press: {name}={text}: expected a number in {' or '.join(units)}")
    if name == "speed" and value == 0.0:
        raise PlateError("press: speed: found 0, expected a number above 0")
    return value


def _press(values: dict[str, float], table: ContactTable, scale: float) -> PlatePress:
    d, theta, pressure = values.get("depth", 0.0), values["tilt"], values.get("pressure", 0.0)
    # Limit the depth to the range in which the contact law is valid at the given tilt.
    d_max = 0.75 * table.tip.radius * (1.0 - abs(math.sin(theta)))
    depths = np.linspace(0.0, d_max, 1001)
    known = table(depths, theta, edge=True)
    depths, forces = depths[known.inside], scale * known.force[known.inside]
    if "force" in values:
        d = float(np.interp(values["force"], forces, depths, right=math.inf))
    pressed = table(d, theta, edge=True)
    if d > d_max or not pressed.inside:
        raise PlateError(
            f"press: the load is too large; expected at most {depths[-1] * 1e3:.2f} mm or "
            f"{forces[-1]:.1f} N on this tip at a tilt of {math.degrees(theta):g}°"
        )
    force = scale * float(pressed.force)
    return PlatePress(d, theta, pressure, force, values["speed"], values["hold"])


class Plate:
    """Plate whose position above one tip is a piecewise linear function of the hand's time."""

    def __init__(self) -> None:
        self._t = [0.0]
        self._d = [-_CLEARANCE]
        # Press of each interval, and whether the plate is stationary.
        self._doing: list[tuple[PlatePress | None, bool]] = [(None, False)]
        self._reported = -1
        self.arrives = 0.0  # time at which the plate reaches the last press

    def go(self, presses: Sequence[PlatePress], t: float) -> None:
        """Lift the plate off and then perform ``presses``, starting at time ``t``."""
        d, (press, _) = max(self(t).d, -_CLEARANCE), self._doing[self._leg(t)]
        self._t, self._d, self._doing, self._reported = [t], [d], [], -1
        self._add((d + _CLEARANCE) / _LIFT_SPEED, -_CLEARANCE, press)
        for press in presses:
            d = press.d if press.d > 0.0 else -_CLEARANCE
            travel = (d + _CLEARANCE) / press.speed + (_FILL_TIME if press.pressure > 0.0 else 0.0)
            self._add(travel, d, press)
            self.arrives = self._t[-1]
            if press.hold < math.inf:
                self._add(press.hold, d, press, rests=True)
                self._add((d + _CLEARANCE) / _LIFT_SPEED, -_CLEARANCE, press)
                self._add(_PAUSE, -_CLEARANCE, None)
        stays = presses[-1].hold == math.inf
        self._doing.append((presses[-1], True) if stays else (None, False))

    def _add(
        self, duration: float, d: float, press: PlatePress | None, rests: bool = False
    ) -> None:
        self._t.append(self._t[-1] + duration)
        self._d.append(d)
        self._doing.append((press, rests))

    def __call__(self, t: float) -> StageTouch:
        """Return the contact between the plate and the tip at time ``t``."""
        press, rests = self._doing[self._leg(t)]
        d = float(np.interp(t, self._t, self._d))
        if press is None:
            return StageTouch(d, 0.0, 0.0)
        return StageTouch(d, press.theta, press.pressure if rests else 0.0)

    def reached(self, t: float) -> PlatePress | None:
        """Return the press that the plate has reached since the last call, or None."""
        leg = self._leg(t)
        press, rests = self._doing[leg]
        fresh = rests and leg != self._reported
        self._reported = leg if rests else -1
        return press if fresh else None

    def _leg(self, t: float) -> int:
        return max(int(np.searchsorted(self._t, t, side="right")) - 1, 0)
