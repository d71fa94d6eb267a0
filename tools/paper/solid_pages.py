"""Figs. 7 and 10 with a tip of solid rubber: what of the paper's measurements does it explain?

Without friction both are run in simulation (`paper.runs`). A sticking face is that of a press
straight along the plane's normal; rolling isn't, so there is none of it there.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.kinematics.contact.closed_form import Face, Fingertip, closed_forms
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.paper import runs
from softfinger.tools.paper.model_pages import MILLI, MODULUS, TILTS
from softfinger.tools.paper.sheets import (
    DEPTH,
    DOT,
    FORCE,
    RELATIVE,
    DrawnCurve,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
    sheet,
    summary,
    zero_line,
)
from softfinger.tools.style import GREY, INK, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FROM = 2.0  # mm: from there to 8 mm the offset is to be constant
_RUN_TILTS = (0, 15, 30)
_ROLLED_AT = 4  # mm
_PAPERS_ERROR = 1.17  # of the rolling contact
_UNIT = Material.constant(1.0)
_FREE: Face = "frictionless"
_STUCK: Face = "sticking"
_TABLES = {
    face: ContactTable.build(Fingertip(runs.RADIUS, "solid", 0.49, "bonded", face), _UNIT)
    for face in (_FREE, _STUCK)
}
_D = np.arange(1, 33) / 4.0  # mm
_COLORS = {_FREE: KINDS[0], _STUCK: KINDS[1]}


def _springs(d: FloatArray, tilt: float) -> FloatArray:
    return closed_forms(MODULUS, d * MILLI, np.radians(tilt)).force


@cache
def offsets() -> tuple[Sheet, ...]:
    """Tabulate forces of both faces over d and tilt, with the modulus of the most constant offset.

    That is by least squares, F_springs = E F_solid − offset, upright, from 2 to 8 mm.
    """
    d = _D
    force = {
        face: np.array([table(d * MILLI, np.radians(tilt)).force for tilt in TILTS])
        for face, table in _TABLES.items()
    }
    chosen = d >= _FROM
    springs = [_springs(d, tilt) for tilt in TILTS]
    columns: list[tuple[str, str, FloatArray]] = [("d", "mm", d)]
    rows = []
    for face, each in force.items():
        modulus = float(np.polyfit(each[0][chosen], springs[0][chosen], 1)[0])
        for tilt, solid, spring in zip(TILTS, each, springs, strict=True):
            columns.append((f"F, {face}, at {tilt} deg", "N", modulus * solid))
            columns.append(
                (f"F, {face}, over springs at {tilt} deg", "N", modulus * solid - spring)
            )
            more = (modulus * solid - spring)[chosen]
            rows.append((modulus * 1e-6, tilt, more.mean(), more.std(), more[-1]))
    columns += [(f"F of springs at {t} deg", "N", f) for t, f in zip(TILTS, springs, strict=True)]
    heads = (
        ("modulus", "MPa"),
        ("tilt", "deg"),
        ("mean offset", "N"),
        ("its deviation over d", "N"),
        ("offset at 8 mm", "N"),
    )
    count = len(TILTS)
    return (
        sheet("solid_run_forces", *columns),
        summary("solid_run_offsets_frictionless", heads, rows[:count]),
        summary("solid_run_offsets_sticking", heads, rows[count:]),
    )


@cache
def solid_runs() -> tuple[Sheet, ...]:
    """Return the offsets, and the frictionless runs."""
    made = offsets()
    modulus = 1e6 * float(made[1]["modulus"][0])
    for tilt in _RUN_TILTS:
        run = runs.compression(float(np.radians(tilt)), runs.solid(modulus))
        found = (("d estimated", "mm", 1e3 * run.d_found), ("F estimated", "N", run.force_found))
        made += (sheet(f"solid_run_{tilt}deg", ("F", "N", run.force), *found),)
    run = runs.rolling(_ROLLED_AT * MILLI, runs.solid(modulus))
    rolled = sheet(
        "solid_run_rolling",
        ("theta", "deg", -np.degrees(run.theta)),
        ("F", "N", run.force),
        ("theta estimated", "deg", -np.degrees(run.theta_found)),
        ("F estimated", "N", run.force_found),
    )
    return (*made, rolled)


def _forces(forces: Sheet, *sheets: Sheet) -> Iterator[DrawnCurve]:
    d = forces["d"]
    dashes: tuple[tuple[int, Any], ...] = ((0, "-"), (30, (0, (5, 1.5))))
    for k, (tilt, dash) in enumerate(dashes):
        for face, color in _COLORS.items():
            label = "" if k else f"solid, {face}"
            look = {"color": color, "linestyle": dash}
            yield DrawnCurve(d, forces[f"F, {face}, at {tilt} deg"], look, label)
        look = {"color": INK, "linestyle": dash, "linewidth": 1.0}
        yield DrawnCurve(d, forces[f"F of springs at {tilt} deg"], look, "" if k else "springs")
        run = sheets[2 + _RUN_TILTS.index(tilt)]
        found = run["d estimated"][::8], run["F estimated"][::8]
        yield DrawnCurve(*found, DOT, "" if k else "estimated from frames")
    yield DrawnCurve([], [], {"color": GREY, "linestyle": (0, (5, 1.5))}, "tilt 30°")


def _over_springs(forces: Sheet, *_: Sheet) -> Iterator[DrawnCurve]:
    for face, color in _COLORS.items():
        for style, tilt in zip(ordered(4), (0, 10, 20, 30), strict=True):
            look = {"color": color, "linestyle": style["linestyle"]}
            over = forces[f"F, {face}, over springs at {tilt} deg"]
            yield DrawnCurve(forces["d"], over, look, "" if face == _STUCK else f"{tilt}°")


def _rolling(*sheets: Sheet) -> Iterator[DrawnCurve]:
    run = sheets[-1]
    theta = run["theta"]
    upright = float(np.interp(0.0, theta, run["F"]))
    yield DrawnCurve(theta, 1.0 / np.cos(np.radians(theta)), {"color": INK}, "springs")
    yield DrawnCurve(theta, run["F"] / upright, {"color": KINDS[0]}, "solid, frictionless")
    found = run["theta estimated"][::5], run["F estimated"][::5] / upright
    yield DrawnCurve(*found, DOT, "estimated from frames")


def _ratios(forces: Sheet, *_: Sheet) -> Iterator[DrawnCurve]:
    d = forces["d"]
    seen = d > 1.0
    for face, color in _COLORS.items():
        ratio = forces[f"F, {face}, at 0 deg"] / forces["F of springs at 0 deg"]
        yield DrawnCurve(d[seen], ratio[seen], {"color": color}, f"solid, {face}")


def _papers_error(axes: Axes, *_: Sheet) -> None:
    axes.axhline(1.0, color=INK, linewidth=0.7)
    axes.axhline(_PAPERS_ERROR, color=GREY, linewidth=0.9, linestyle=":")
    axes.text(8.0, _PAPERS_ERROR, "the paper's 17 %", ha="right", va="bottom", fontsize=7.5)


PAGES = {
    "solid_run": FigurePage(
        "Figs. 7 and 10 with a tip of solid rubber, bonded to the sensor, ν = 0.49",
        (7.6, 7.0),
        solid_runs,
        (
            Panel(_forces, DEPTH, FORCE, "(a) compression", (0, 8), (0, 82), "upper left"),
            Panel(_over_springs, DEPTH, "F − F of springs [N]", "(b) Fig. 7's offset, by tilt",
                  (0, 8), (-25, 10),
                  {"loc": "lower left", "ncols": 2, "title": "tilt; blue, orange as in (a)"},
                  zero_line),
            Panel(_rolling, RELATIVE, "F(θ)/F(0)", "(c) rolling at 4 mm", (-12, 10), (0.95, 1.05),
                  "upper right"),
            Panel(_ratios, DEPTH, "F over F of springs", "(d) upright: the 17 % of rolling",
                  (0, 8), (0.75, 1.5), "upper right", _papers_error),
        ),
        rows=2,
        notes=(
            "The paper's points are pictures only; its text tells a near-constant error at every "
            "angle, 17 % in rolling, and a least force slightly before 0°. Springs: E = 0.304 MPa. "
            "Solid: the E that makes the offset upright most constant from 2 to 8 mm.",
            "Neither explains the offset: rubber stiffens so much with strain that its difference "
            "from springs is no constant at any E. Frictionless (0.125 MPa) it is −3.7 to 1.0 N "
            "upright from 2 to 8 mm, and −25 N at 30° and 8 mm; sticking, pressed straight (0.119 "
            "MPa), −5.0 to 1.4 N upright, and −8.5 to 8.6 N at 30°.",
            "In rolling, without friction F is largest at 0°. 17 % above springs it is at 1.2 mm "
            "alone, upright; the paper gives no depth.",
        ),
    ),
}  # fmt: skip
