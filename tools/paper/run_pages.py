"""Figs. 7, 8 and 10 run in simulation (`paper.runs`): the model, what was estimated, the error."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from softfinger.tools.paper import runs
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, TILTS
from softfinger.tools.paper.runs import SimulatedRun
from softfinger.tools.paper.sheets import (
    CIRCLE,
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
from softfinger.tools.style import GREY, INK, KINDS, label_ends, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SURE = 1.0  # mm of displacement from which on relative errors are shown
_DEEPEST_FORCE = 1e-6 * np.pi * runs.MODULUS * 8.0**2  # N at 8 mm, upright
_ROLLED_AT = 4  # mm, where rotation ends and the path goes on
_PATH = -12.5, 10.5


def _columns(
    run: SimulatedRun, suffix: str, sign: float = 1.0
) -> list[tuple[str, str, FloatArray]]:
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


@cache
def compression() -> tuple[Sheet, ...]:
    """Return one sheet an angle, and one with the errors beyond 1 mm."""
    sheets, rows = [], []
    for tilt in TILTS:
        run = runs.compression(float(np.radians(tilt)))
        sheets.append(sheet(f"fig7_run_{tilt}deg", *_columns(run, "")))
        deep = run.d > _SURE * MILLI
        force = (run.force_found / np.maximum(run.force, 1e-9) - 1.0)[deep]
        energy = (run.energy_found / np.maximum(run.energy, 1e-12) - 1.0)[deep]
        rows.append(
            (
                tilt,
                1e3 * float(run.d[run.d_found > 0.0][0]),
                1e6 * _rms((run.d_found - run.d)[deep]),
                _rms(np.degrees(run.theta_found - run.theta)[deep]),
                100.0 * float(force.mean()),
                100.0 * _rms(force),
                100.0 * _rms(energy),
            )
        )
    heads = (
        ("tilt", "deg"),
        ("d at the first estimate", "mm"),
        ("RMS error of d", "um"),
        ("RMS error of theta", "deg"),
        ("mean error of F", "%"),
        ("RMS error of F", "%"),
        ("RMS error of U", "%"),
    )
    return (*sheets, summary("fig7_run_errors", heads, rows))


def _forces(*sheets: Sheet) -> Iterator[DrawnCurve]:
    for style, run in zip(ordered(len(TILTS)), sheets, strict=False):
        yield DrawnCurve(run["d"], run["F"], style)
        yield DrawnCurve(run["d estimated"][::6], run["F estimated"][::6], DOT)
    yield DrawnCurve([], [], {"color": INK}, "model")
    yield DrawnCurve([], [], CIRCLE | {"ms": 3, "mec": INK}, "estimated from the frames")


def _angles(axes: Axes, *_: Sheet) -> None:
    ends = [_DEEPEST_FORCE / float(np.cos(np.radians(tilt))) for tilt in TILTS]
    label_ends(axes, 8.0, ends, [f"{tilt}°" for tilt in TILTS], gap=0.07)


def _errors(symbol: str, *sheets: Sheet) -> Iterator[DrawnCurve]:
    """Yield the errors of force [%], displacement [µm] or angle [degrees], beyond 1 mm."""
    for tilt, style, run in zip(TILTS, ordered(len(TILTS)), sheets, strict=False):
        deep = run["d"] > _SURE
        truth, found = run[symbol][deep], run[f"{symbol} estimated"][deep]
        if symbol == "F":
            off = 100.0 * (found / truth - 1.0)
        else:
            off = (found - truth) * (1e3 if symbol == "d" else 1.0)
        yield DrawnCurve(run["d"][deep], off, style | {"linewidth": 0.9}, f"{tilt}°")


def _error_panel(symbol: str, title: str, label: str, limit: float) -> Panel:
    legend = {"loc": "lower right", "ncols": 4, "title": "tilt"}
    ends = (0, 8), (-1.3 * limit, limit)
    return Panel(partial(_errors, symbol), DEPTH, label, title, *ends, legend, zero_line)


@cache
def tilt_and_roll() -> tuple[Sheet, ...]:
    """Return rotation, the rolling at each displacement, and where force and energy are least."""
    columns, minima = [], []
    for depth in DEPTHS:
        run = runs.rolling(depth * MILLI)
        columns += _columns(run, f" at {depth} mm", -1.0)
        theta = -np.degrees(run.theta)
        minima.append(
            (
                depth,
                *_minimum(theta, run.force_found),
                *_minimum(theta, run.energy_found),
                100.0 * _rms(run.force_found / run.force - 1.0),
                100.0 * _rms(run.energy_found / run.energy - 1.0),
                _rms(np.degrees(run.theta_found - run.theta)),
            )
        )
    heads = (
        ("d", "mm"),
        ("angle of the least F estimated", "deg"),
        ("its standard error, F", "deg"),
        ("angle of the least U estimated", "deg"),
        ("its standard error, U", "deg"),
        ("RMS error of F", "%"),
        ("RMS error of U", "%"),
        ("RMS error of theta", "deg"),
    )
    return (
        sheet("fig10_run_rotation", *_columns(runs.rotation(), "", -1.0)),
        sheet("fig10_run_rolling", *columns),
        summary("fig10_run_minimum", heads, minima),
    )


def _minimum(theta: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Return where a parabola in θ through all values is least, and the standard error of that.

    Without noise both curves are parabolas within 0.1 %. The error is that of the fit, from its
    residuals: runs with ten seeds scattered by as much.
    """
    (a, b, _), covariance = np.polyfit(theta, values, 2, cov=True)
    slope = np.array([0.5 * b / a**2, -0.5 / a, 0.0])
    return float(-0.5 * b / a), float(np.sqrt(slope @ covariance @ slope))


def _along(symbol: str, rotation: Sheet, rolling: Sheet, _: Sheet) -> Iterator[DrawnCurve]:
    """Tabulate along the path: the rotation, then the rolling at 4 mm."""
    for piece, at, color, name in (
        (rotation, "", KINDS[1], "the finger rotates"),
        (rolling, f" at {_ROLLED_AT} mm", KINDS[0], "then the object rolls"),
    ):
        yield DrawnCurve(piece[f"theta{at}"], piece[f"{symbol}{at}"], {"color": color}, name)
        theta, found = piece[f"theta estimated{at}"], piece[f"{symbol} estimated{at}"]
        yield DrawnCurve(theta[::4], found[::4], DOT, "estimated" if at else "")


def _over_upright(_: Sheet, rolling: Sheet, minima: Sheet) -> Iterator[DrawnCurve]:
    for depth, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        theta, model = rolling[f"theta at {depth} mm"], rolling[f"U at {depth} mm"]
        level = float(np.interp(0.0, theta, model))
        found = rolling[f"U estimated at {depth} mm"]
        yield DrawnCurve(theta, found / level, style | {"linewidth": 0.9})
        yield DrawnCurve(theta, model / level, {"color": GREY, "linewidth": 0.7})


def _show_minima(axes: Axes, _: Sheet, rolling: Sheet, minima: Sheet) -> None:
    """The least angles with their standard errors, enlarged, one line a displacement."""
    found, error = minima["angle of the least U estimated"], minima["its standard error, U"]
    inset = axes.inset_axes((0.33, 0.14, 0.4, 0.28))
    for k, style in enumerate(ordered(len(DEPTHS))):
        inset.errorbar(found[k], -k, xerr=error[k], fmt="o", ms=3, color=style["color"], capsize=2)
        text = f"{DEPTHS[k]} mm: {found[k]:.2f}° ± {error[k]:.2f}°".replace("-", "−")
        inset.text(1.03, -k, text, transform=inset.get_yaxis_transform(), va="center", fontsize=7)
    inset.axvline(0.0, color=GREY, linewidth=0.7)
    inset.set(xlim=(-0.8, 0.8), ylim=(0.6 - len(DEPTHS), 0.4), yticks=[])
    inset.set_title("least at θ [deg]", fontsize=7.5, pad=2)
    inset.tick_params(labelsize=7, pad=1)


def _angle_errors(_: Sheet, rolling: Sheet, minima: Sheet) -> Iterator[DrawnCurve]:
    for depth, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        theta = rolling[f"theta at {depth} mm"]
        off = rolling[f"theta estimated at {depth} mm"] - theta
        yield DrawnCurve(theta, off, style | {"linewidth": 0.9}, f"d = {depth} mm")


PAGES = {
    "fig7_run": FigurePage(
        "Fig. 7 run in simulation: compression to 8 mm, through sensor and estimator",
        (7.6, 6.2),
        compression,
        (
            Panel(_forces, DEPTH, FORCE, "(a) force", (0, 8.6), (0, 78), "upper left", _angles),
            _error_panel("F", "(b) error of the force", "estimate over model − 1 [%]", 5.0),
            _error_panel("d", "(c) error of the displacement", "estimate − truth [µm]", 75.0),
            _error_panel("theta", "(d) error of the angle", "estimate − truth [deg]", 0.5),
        ),
        rows=2,
        notes=(
            "The plant presses the object on the tip at 2 mm/s; 44 × 44 cells on 58 mm, 25 frames "
            "a second, noise of 0.5 % of E in each cell. Errors are shown from 1 mm on, each point "
            "from one frame alone. Model and sensor are of one kind here: the paper's constant "
            "offset, which comes from the material, does not appear.",
        ),
    ),
    "fig10_run": FigurePage(
        "Figs. 8 to 10 run in simulation: the finger rotates 11.5°, the object rolls 20.7°",
        (7.6, 6.2),
        tilt_and_roll,
        (
            Panel(partial(_along, "F"), RELATIVE, FORCE, "(a) force along the path", _PATH),
            Panel(partial(_along, "U"), RELATIVE, "elastic energy U [mJ]",
                  "(b) energy along the path", _PATH, None, "lower right"),
            Panel(_over_upright, RELATIVE, "U(θ)/U(0)", "(c) energy while rolling, over U(0)",
                  _PATH, (0.86, 1.085), annotate=_show_minima),
            Panel(_angle_errors, RELATIVE, "estimate − truth [deg]",
                  "(d) error of the angle while rolling", _PATH, None,
                  {"loc": "lower right", "ncols": 2}, zero_line),
        ),
        rows=2,
        notes=(
            "Angles with the paper's sign. Rotation: the servo turns the finger about a root 20.1 "
            "mm from the tip's centre, so that d goes from 0 to 4 mm; estimates are the daemon's, "
            "carried on by the joint between frames. Rolling: d is held, estimates are of one "
            "frame. Grey: model. Least: of a parabola through the estimates, ± standard error.",
        ),
    ),
}  # fmt: skip
