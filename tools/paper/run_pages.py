"""Figs. 7, 8 and 10 run in simulation: the model, what was estimated, and the error.

The runs are in `paper.runs`; this module makes their sheets and draws them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.tools.paper import runs
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, TILTS
from softfinger.tools.paper.runs import Run
from softfinger.tools.paper.sheets import FloatArray, Page, Sheet, sheet
from softfinger.tools.paper.style import GREY, INK, KINDS, caption, label_ends, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SURE = 1.0  # mm of displacement from which on relative errors are told
_DEEPEST_FORCE = 1e-6 * np.pi * runs.MODULUS * 8.0**2  # N at 8 mm, upright
_ROLLED_AT = 4  # mm, where rotation ends and the path goes on


@cache
def _compression(tilt: int) -> Run:
    return runs.compression(float(np.radians(tilt)))


@cache
def _rotation() -> Run:
    return runs.rotation()


@cache
def _rolling(depth: int) -> Run:
    return runs.rolling(depth * MILLI)


def _columns(run: Run, suffix: str, sign: float = 1.0) -> list[tuple[str, str, FloatArray]]:
    """A run's columns in the figures' units; ``sign`` is that of the paper's angle."""
    return [
        (f"d{suffix}", "mm", 1e3 * run.d),
        (f"d estimated{suffix}", "mm", 1e3 * run.d_found),
        (f"theta{suffix}", "deg", sign * np.degrees(run.theta)),
        (f"theta estimated{suffix}", "deg", sign * np.degrees(run.theta_found)),
        (f"F{suffix}", "N", run.force),
        (f"F estimated{suffix}", "N", run.force_found),
        (f"U{suffix}", "mJ", 1e3 * run.energy),
        (f"U estimated{suffix}", "mJ", 1e3 * run.energy_found),
    ]


def _rms(off: FloatArray) -> float:
    return float(np.sqrt(np.mean(off**2)))


def compression() -> tuple[Sheet, ...]:
    """One sheet an angle, and one with the errors beyond 1 mm."""
    sheets, rows = [], []
    for tilt in TILTS:
        run = _compression(tilt)
        sheets.append(sheet(f"fig7_run_{tilt}deg", *_columns(run, "")))
        deep = run.d > _SURE * MILLI
        seen = run.d[run.d_found > 0.0]
        rows.append(
            (
                tilt,
                1e3 * float(seen[0]),
                1e6 * _rms((run.d_found - run.d)[deep]),
                _rms(np.degrees(run.theta_found - run.theta)[deep]),
                100.0 * float((run.force_found / np.maximum(run.force, 1e-9) - 1.0)[deep].mean()),
                100.0 * _rms((run.force_found / np.maximum(run.force, 1e-9) - 1.0)[deep]),
                100.0 * _rms((run.energy_found / np.maximum(run.energy, 1e-12) - 1.0)[deep]),
            )
        )
    names = (
        ("tilt", "deg"),
        ("d at the first estimate", "mm"),
        ("RMS error of d", "um"),
        ("RMS error of theta", "deg"),
        ("mean error of F", "%"),
        ("RMS error of F", "%"),
        ("RMS error of U", "%"),
    )
    errors = [
        (name, unit, values)
        for (name, unit), values in zip(names, zip(*rows, strict=True), strict=True)
    ]
    return (*sheets, sheet("fig7_run_errors", *errors))


def draw_compression(figure: Figure, sheets: Sequence[Sheet]) -> None:
    """Force over d at each angle, then the errors over d: of force, d and θ."""
    panels = figure.subplots(2, 2).ravel()
    styles = ordered(len(TILTS))
    ends = [_DEEPEST_FORCE / float(np.cos(np.radians(tilt))) for tilt in TILTS]
    for style, run in zip(styles, sheets, strict=False):
        d, deep = run["d"], run["d"] > _SURE
        panels[0].plot(d, run["F"], **style)
        panels[0].plot(
            run["d estimated"][::6],
            run["F estimated"][::6],
            "o",
            ms=3,
            mfc="none",
            mec=INK,
            mew=0.6,
        )
        line = style | {"linewidth": 0.9}
        panels[1].plot(d[deep], 100.0 * (run["F estimated"][deep] / run["F"][deep] - 1.0), **line)
        panels[2].plot(d[deep], 1e3 * (run["d estimated"] - run["d"])[deep], **line)
        panels[3].plot(d[deep], (run["theta estimated"] - run["theta"])[deep], **line)
    panels[0].plot([], [], "-", color=INK, label="model")
    panels[0].plot([], [], "o", ms=3, mfc="none", mec=INK, label="estimated from the frames")
    panels[0].set(
        xlim=(0, 8.6), ylim=(0, 78), ylabel="total elastic force F [N]", title="(a) force"
    )
    label_ends(panels[0], 8.0, ends, [f"{tilt}°" for tilt in TILTS], gap=0.07)
    panels[0].legend(loc="upper left")
    for axes, title, label in (
        (panels[1], "(b) error of the force", "estimate over model − 1 [%]"),
        (panels[2], "(c) error of the displacement", "estimate − truth [µm]"),
        (panels[3], "(d) error of the angle", "estimate − truth [deg]"),
    ):
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        axes.set(xlim=(0, 8), ylabel=label, title=title)
    for axes in panels:
        axes.set_xlabel("displacement d [mm]")
    _caption(figure, "fig7_run")


def tilt_and_roll() -> tuple[Sheet, ...]:
    """The rotation, the rolling at each displacement, and where force and energy are least."""
    first = sheet("fig10_run_rotation", *_columns(_rotation(), "", -1.0))
    columns = []
    least = []
    for depth in DEPTHS:
        run = _rolling(depth)
        columns += _columns(run, f" at {depth} mm", -1.0)
        theta = -np.degrees(run.theta)
        least.append(
            (
                depth,
                _minimum(theta, run.force_found),
                _minimum(theta, run.energy_found),
                100.0 * _rms(run.force_found / run.force - 1.0),
                100.0 * _rms(run.energy_found / run.energy - 1.0),
                _rms(np.degrees(run.theta_found - run.theta)),
            )
        )
    names = (
        ("d", "mm"),
        ("angle of the least F estimated", "deg"),
        ("angle of the least U estimated", "deg"),
        ("RMS error of F", "%"),
        ("RMS error of U", "%"),
        ("RMS error of theta", "deg"),
    )
    summary = [
        (name, unit, values)
        for (name, unit), values in zip(names, zip(*least, strict=True), strict=True)
    ]
    return first, sheet("fig10_run_rolling", *columns), sheet("fig10_run_minimum", *summary)


def _minimum(theta: FloatArray, values: FloatArray) -> float:
    """Where a parabola in θ through all values is least; both curves are one within 0.1 %."""
    curve = np.polynomial.Polynomial.fit(theta, values, 2).convert()
    return float(-0.5 * curve.coef[1] / curve.coef[2])


def draw_tilt_and_roll(figure: Figure, sheets: Sequence[Sheet]) -> None:
    """(a) the force, (b) the energy along the path at 4 mm, (c, d) rolling at every depth."""
    rotation, rolling, least = sheets
    panels = figure.subplots(2, 2).ravel()
    suffix = f" at {_ROLLED_AT} mm"
    for axes, symbol, label in (
        (panels[0], "F", "total elastic force F [N]"),
        (panels[1], "U", "elastic energy U [mJ]"),
    ):
        for part, end, color, name in (
            (rotation, "", KINDS[1], "the finger rotates"),
            (rolling, suffix, KINDS[0], "then the object rolls"),
        ):
            axes.plot(part[f"theta{end}"], part[f"{symbol}{end}"], color=color, label=name)
            axes.plot(
                part[f"theta estimated{end}"][::4],
                part[f"{symbol} estimated{end}"][::4],
                "o",
                ms=3,
                mfc="none",
                mec=INK,
                mew=0.6,
                label="estimated" if end else None,
            )
        axes.set(ylabel=label, xlim=(-12.5, 10.5))
    panels[0].set_title("(a) force along the path")
    panels[1].set_title("(b) energy along the path")
    panels[1].legend(loc="lower right")
    for depth, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        end = f" at {depth} mm"
        theta = rolling[f"theta{end}"]
        _relative(panels[2], theta, rolling[f"U{end}"], rolling[f"U estimated{end}"], style)
        off = rolling[f"theta estimated{end}"] - theta
        panels[3].plot(theta, off, **(style | {"linewidth": 0.9}), label=f"d = {depth} mm")
    panels[2].plot(0.0, 1.0, "v", ms=7, color=INK)
    angles = ", ".join(f"{each:.2f}°" for each in least["angle of the least U estimated"])
    panels[2].set(
        title="(c) energy while rolling, over U(0)",
        ylabel="U(θ)/U(0)",
        xlim=(-12.5, 10.5),
        ylim=(0.955, 1.095),
    )
    panels[2].text(
        -1.0, 1.084, f"least at {angles}".replace("-", "−"), ha="center", fontsize=7.5, color=INK
    )
    panels[3].axhline(0.0, color=GREY, linewidth=0.7)
    panels[3].set(
        title="(d) error of the angle while rolling",
        ylabel="estimate − truth [deg]",
        xlim=(-12.5, 10.5),
    )
    panels[3].legend(loc="lower right", ncols=2)
    for axes in panels:
        axes.set_xlabel("relative angle θ [deg]")
    _caption(figure, "fig10_run")


def _relative(
    axes: Axes, theta: FloatArray, model: FloatArray, found: FloatArray, style: dict[str, Any]
) -> None:
    level = float(np.interp(0.0, theta, model))
    axes.plot(theta, found / level, **(style | {"linewidth": 0.9}))
    axes.plot(theta, model / level, color=GREY, linewidth=0.7)


def _caption(figure: Figure, name: str) -> None:
    caption(figure, PAGES[name].notes)


PAGES = {
    "fig7_run": Page(
        title="Fig. 7 run in simulation: compression to 8 mm, through sensor and estimator",
        size=(7.6, 6.2),
        sheets=compression,
        draw=draw_compression,
        notes=(
            "The plant presses the object on the tip at 2 mm/s; 44 × 44 cells on 58 mm, 25 frames "
            "a second, noise of 0.5 % of E in each cell. Errors are shown from 1 mm on, each point "
            "from one frame alone. Model and sensor are of one kind here: the paper's constant "
            "offset, which comes from the material, does not appear.",
        ),
    ),
    "fig10_run": Page(
        title="Figs. 8 to 10 run in simulation: the finger rotates 11.5°, the object rolls 20.7°",
        size=(7.6, 6.2),
        sheets=tilt_and_roll,
        draw=draw_tilt_and_roll,
        notes=(
            "Angles with the paper's sign. Rotation: the servo turns the finger about a root 20.1 "
            "mm from the tip's centre, so that d goes from 0 to 4 mm; estimates are the daemon's, "
            "carried on by the joint between frames. Rolling: d is held, estimates are of one "
            "frame. Grey: model. Least: of a parabola through the estimates at 2, 4, 6 and 8 mm.",
        ),
    ),
}
