"""The basin of the minimum: which objects, put askew, end upright, and how far off the others end.

Every point is a grasp by the daemon on the simulated hand, on virtual time, judged by the plant's
truth; together a minute or two.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.daemon.control.modes import Mode
from softfinger.kinematics.hand.upright import resting_ratio
from softfinger.tools.benchmarks.control import EQUAL_TORQUES
from softfinger.tools.paper.sheets import DrawnCurve, FigurePage, FloatArray, Panel, Sheet, sheet
from softfinger.tools.style import GREY, KINDS, MARKERS
from softfinger.tools.watched import Watched

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TILTS = (2.5, 5.0, 10.0, 20.0, 30.0)  # degrees
STARTS = (-30.0, -20.0, -10.0, -5.0, 0.0, 5.0, 10.0, 20.0, 30.0)
# Settings of `control`, and what the picture calls them.
LAWS: dict[str, tuple[dict[str, Any], str]] = {
    "blind": (EQUAL_TORQUES, "equal torques"),
    "energy": ({}, "energy, its angle kept"),
    "upright": ({"law": "upright"}, "upright"),
}
# What is varied beside the tilt: unit and values.
ACROSS: dict[str, tuple[str, tuple[float, ...]]] = {
    "offset": ("mm", (-8.0, -4.0, 0.0, 4.0, 8.0)),
    "force": ("N", (1.0, 2.0, 4.0, 8.0, 16.0)),
    "tip friction": ("1", (0.05, 0.1, 0.2, 0.4, 0.8)),
    "joint friction": ("N m", (0.0, 0.05, 0.1, 0.15, 0.2)),
    "table friction": ("1", (0.0, 0.3, 0.6, 0.9, 1.2)),
}
_FORCE = 10.0  # N
_SECONDS = 4.5  # from the command on
_DEPTH, _WIDTH, _LENGTHS = (
    0.0032,
    0.040,
    (0.05, 0.08, 0.0, 0.02),
)  # at that force, of the paper's tip
_CLEAR, _LOST = 0.05, 5.0  # degrees between which the maps' colours run


def left(law: str, tilt: float, force: float = _FORCE, **simulation: Any) -> float:
    """Return the object's angle after a grasp [degrees]; NaN if it isn't held."""
    sections: dict[str, dict[str, Any]] = {
        "material": {"law": "constant"},
        "control": LAWS[law][0],
        "simulation": {"object_angle": float(np.radians(tilt)), **simulation},
    }
    with Watched(sections) as hand:
        hand.grasp(force)
        hand.run(_SECONDS)
        held = hand.mode == Mode.HOLDING
        return float(np.degrees(hand.plant.object_pose[2])) if held else float("nan")


def _varied(name: str, value: float) -> dict[str, Any]:
    if name == "offset":
        return {"object_position": (1e-3 * value, 0.080)}
    return {name.replace(" ", "_"): value}


@cache
def basin() -> tuple[Sheet, ...]:
    """Return where each law leaves an object over where it was, and what the upright law leaves."""
    ends = [(f"left by {law}", "deg", [left(law, tilt) for tilt in STARTS]) for law in LAWS]
    sheets = [sheet("basin_laws", ("put at", "deg", STARTS), *ends)]
    for name, (unit, values) in ACROSS.items():
        points = [(tilt, value) for value in values for tilt in TILTS]
        found = [left("upright", tilt, **_varied(name, value)) for tilt, value in points]
        tilts, others = zip(*points, strict=True)
        title = f"basin_{name.replace(' ', '_')}"
        columns = ("put at", "deg", tilts), (name, unit, others), ("left", "deg", found)
        sheets.append(sheet(title, *columns))
    return tuple(sheets)


def _laws(laws: Sheet, *_: Sheet) -> Iterator[DrawnCurve]:
    starts = laws["put at"]
    for spring, text in ((0.0, "equal torques, no friction"), (1e9, "fingers locked")):
        ratio = resting_ratio(_DEPTH, _WIDTH, spring, _FORCE, _LENGTHS)
        line = {"color": GREY, "ls": "--" if spring else ":", "lw": 1.0}
        yield DrawnCurve(starts, ratio * starts, line, f"closed form: {text}")
    for law, color, marker in zip(LAWS, KINDS, MARKERS, strict=False):
        text = LAWS[law][1]
        yield DrawnCurve(starts, laws[f"left by {law}"], {"color": color, "marker": marker}, text)


def _map(place: int, axes: Axes, *sheets: Sheet) -> None:
    """One map, its cells as wide as each other whatever their values, what is left written in."""
    from matplotlib.colors import LogNorm

    _, values = list(ACROSS.values())[place]
    shape = (len(values), len(TILTS))
    off: FloatArray = np.abs(sheets[1 + place]["left"]).reshape(shape)
    shown = np.clip(np.nan_to_num(off, nan=_LOST), _CLEAR, _LOST)
    axes.imshow(shown, origin="lower", aspect="auto", cmap="cividis_r", norm=LogNorm(_CLEAR, _LOST))
    axes.grid(False)
    for (row, column), value in np.ndenumerate(off):
        text = "lost" if np.isnan(value) else f"{value:.2f}"
        dark = shown[row, column] > np.sqrt(_CLEAR * _LOST)
        axes.text(column, row, text, ha="center", va="center", color="w" if dark else "k", size=7)
    axes.set_xticks(range(len(TILTS)), [f"{tilt:g}" for tilt in TILTS])
    axes.set_yticks(range(len(values)), [f"{value:g}" for value in values])


def _panel(place: int, name: str, unit: str) -> Panel:
    label = name if unit == "1" else f"{name} [{unit.replace(' ', '·')}]"
    title = f"left by upright [deg], over {name}"
    return Panel(lambda *_: (), "put at [deg]", label, title, annotate=partial(_map, place))


PAGES = {
    "basin": FigurePage(
        "The basin of the minimum: objects put askew between the fingers",
        (10.0, 6.4),
        basin,
        (
            Panel(_laws, "put at [deg]", "left [deg]",
                  f"where each law leaves the object, {_FORCE:g} N", None, (-30, 68), "upper left"),
            *(_panel(k, name, unit) for k, (name, (unit, _)) in enumerate(ACROSS.items())),
        ),
        rows=2,
        notes=(
            "Simulated, with the paper's tip, an object of 100 g and 40 mm, and, where not varied, "
            "tip friction 0.6, joint friction 0.05 N·m and table friction 0.3.",
        ),
    )
}  # fmt: skip
