"""Pages over time, of the contacts with the object and of the joints; and the loop's own times."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.tools import style
from softfinger.tools.analysis.plots_data import MODES, FloatArray, RecordedRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DEGREES = 180.0 / np.pi
LINES: dict[str, dict[str, Any]] = {
    "left": {"color": style.KINDS[0], "linestyle": "-"},
    "right": {"color": style.KINDS[1], "linestyle": (0, (5, 1.5))},
}
GOAL: dict[str, Any] = {"color": style.INK, "linestyle": (0, (1, 1.2)), "linewidth": 1.2}

# Shade and hatch of each mode, distinguishable in print.
_LOOKS = {
    "disarmed": ("#ffffff", ""),
    "armed": ("#e3e3e3", ""),
    "moving": ("#e3e3e3", "----"),
    "grasping": ("#c4c4c4", "////"),
    "holding": ("#9a9a9a", ""),
    "rotating": ("#c4c4c4", "\\\\\\\\"),
    "releasing": ("#e3e3e3", "...."),
    "fault": ("#202020", ""),
}

# Title, field, factor to the unit shown, unit
_CONTACT = (
    ("force F", "force", 1.0, "N"),
    ("energy U", "energy", 1e3, "mJ"),
    ("displacement d", "d", 1e3, "mm"),
)
# Title, field, its goal, factor, unit
_JOINT = (
    ("joint q", "q", "goal_q", DEGREES, "°"),
    ("current", "current", "goal_current", 1.0, "A"),
    ("temperature", "temperature", "", 1.0, "°C"),
)
_RAISED = 0.01  # of the request: by more than that the goal differs from it


def draw_time(run: RecordedRun) -> Figure:
    """Force, energy, displacement and the object's angle over time, with their goals."""
    run.need_contact()
    figure, strip, panels = _sheet(run, 4, 7.6)
    for panel, (name, field, factor, unit) in zip(panels, _CONTACT, strict=False):
        for finger in run.fingers:
            shown = np.where(run.touching(finger), run.states[f"{finger}.{field}"] * factor, np.nan)
            _line(panel, run, shown, label=finger, **LINES[finger])
        panel.set_ylabel(f"{name} [{unit}]")
        panel.set_ylim(bottom=0.0)
    _goals(panels[0], run, run.states["goal_force"], run.requested_force())
    sound = run.states["object.valid"] > 0.0
    angle = np.where(sound, run.states["object.angle"] * DEGREES, np.nan)
    _line(panels[3], run, angle, color=style.KINDS[2], label="object")
    goal = run.states["goal_angle"] * DEGREES
    _goals(panels[3], run, goal, run.requested_angle() * DEGREES)
    panels[3].set_ylabel("object's angle φ [°]")
    _finish(figure, run, strip, panels)
    return figure


def _goals(panel: Axes, run: RecordedRun, goal: FloatArray, requested: FloatArray) -> None:
    """The hand's goal, and the request where it differs."""
    _line(panel, run, goal, label="goal", **GOAL)
    other = np.where(np.abs(requested - goal) > _RAISED * np.abs(requested), requested, np.nan)
    if np.isfinite(other).any():
        look = {"color": style.GREY, "linestyle": (0, (6, 2)), "linewidth": 0.9}
        _line(panel, run, other, label="requested", **look)


def draw_joints(run: RecordedRun) -> Figure:
    """Joint angles and currents with their goals, and the servos' temperature, over time."""
    run.need_states()
    figure, strip, panels = _sheet(run, 3, 6.2)
    for panel, (name, field, goal, factor, unit) in zip(panels, _JOINT, strict=True):
        for finger in run.fingers:
            values = run.states[f"{finger}.{field}"] * factor
            if field == "temperature":
                values = np.where(values != 0.0, values, np.nan)  # 0: not known
            _line(panel, run, values, label=finger, **LINES[finger])
            if goal:
                look = {**LINES[finger], "linestyle": (0, (1, 1.2)), "linewidth": 0.9}
                _line(panel, run, run.states[f"{finger}.{goal}"] * factor, **look)
        panel.set_ylabel(f"{name} [{unit}]")
    panels[0].plot([], [], color=style.GREY, linestyle=(0, (1, 1.2)), label="goal or limit")
    panels[2].margins(y=0.3)
    _finish(figure, run, strip, panels)
    return figure


def _sheet(run: RecordedRun, count: int, height: float) -> tuple[Figure, Axes, list[Axes]]:
    figure = style.new_figure(7.0, height)
    axes = figure.subplots(
        1 + count, 1, sharex=True, gridspec_kw={"height_ratios": [0.13, *[1.0] * count]}
    )
    return figure, axes[0], list(axes[1:])


def _line(panel: Axes, run: RecordedRun, values: FloatArray, **look: Any) -> None:
    panel.plot(*run.gapped(values), **look)


def _finish(figure: Figure, run: RecordedRun, strip: Axes, panels: list[Axes]) -> None:
    from matplotlib.patches import Patch

    _draw_modes(strip, run)
    for panel in panels:
        for when, _ in run.faults:
            panel.axvline(when, color=style.INK, linewidth=0.9)
    for when, reason in run.faults[:1]:
        panels[0].annotate(
            reason if len(reason) < 60 else reason[:59] + "…",
            (when, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, -3),
            textcoords="offset points",
            va="top",
            fontsize=7.0,
        )
    strip.set_title(run.name, loc="left")
    time_axis(panels[-1], run.t)
    figure.align_ylabels()
    used = [name for k, name in enumerate(MODES) if (run.modes == k).any()]
    handles: list[Any] = [
        Patch(facecolor=_LOOKS[name][0], hatch=_LOOKS[name][1], edgecolor=style.INK, lw=0.4)
        for name in used
    ]
    names = list(used)
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            if label not in names:
                handles.append(handle)
                names.append(label)
    figure.legend(handles, names, loc="outside lower center", ncols=6)


def time_axis(panel: Axes, t: FloatArray) -> None:
    """Label and limits of the time axis."""
    panel.set_xlabel("time [s]")
    panel.set_xlim(float(t[0]), float(max(t[-1], t[0] + 1e-3)))


def titled(figure: Figure, run: RecordedRun, text: str) -> None:
    """The recording's name and ``text`` above a figure."""
    figure.suptitle(f"{run.name}: {text}", x=0.01, ha="left", fontsize=9.0)


def _draw_modes(strip: Axes, run: RecordedRun) -> None:
    """The hand's modes as one band."""
    edges = np.flatnonzero(np.diff(run.modes)) + 1
    starts = [0, *edges.tolist()]
    for first, after in itertools.zip_longest(starts, starts[1:], fillvalue=len(run.modes)):
        if run.modes[first] < 0:
            continue
        colour, hatch = _LOOKS[MODES[run.modes[first]]]
        left, right = run.t[first], run.t[min(after, len(run.t) - 1)]
        strip.axvspan(left, right, facecolor=colour, hatch=hatch, edgecolor=style.INK, lw=0.3)
    strip.set_yticks([])
    strip.set_ylim(0.0, 1.0)
    strip.grid(visible=False)
    strip.tick_params(bottom=False, labelbottom=False)
    strip.set_ylabel("mode", rotation=0, ha="right", va="center")
    for side in strip.spines.values():
        side.set_visible(False)


_BINS = 60
_TIMES = (("tick", "tick_s"), ("compute", "compute_s"), ("wake-up, late by", "wake_late_s"))
_PARTS = ("wake", "compute", "bus", "publish")
_SHARES = (("p50", "median"), ("p99", "p99"), ("p999", "p99.9"), ("max", "max"))


def draw_timing(run: RecordedRun) -> Figure:
    """Tick, compute and wake-up times, and the last ``hand/stats``."""
    run.need_states()
    heights = [1.0] if run.stats is None else [1.0, 0.42]
    figure = style.new_figure(7.2, 3.2 if run.stats is None else 4.6)
    grid = figure.add_gridspec(len(heights), 3, height_ratios=heights)
    for column, (title, field) in enumerate(_TIMES):
        panel = figure.add_subplot(grid[0, column])
        _histogram(panel, run.states[field] * 1e6)
        panel.set(title=title, xlabel="time [µs]")
        if column == 0:
            panel.set_ylabel("states")
    if run.stats is not None:
        panel = figure.add_subplot(grid[1, :])
        _table(panel, run.stats)
    step = np.diff(run.states["seq"])
    every = int(np.median(step)) if step.size else 1
    of = "every tick" if every <= 1 else f"one tick of {every}"
    overruns = run.states["overruns"]
    overrun = int(overruns[-1] - overruns[0])
    titled(figure, run, f"{run.t.size} states, of {of}; {overrun} overruns")
    return figure


def _histogram(panel: Axes, values: FloatArray) -> None:
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        panel.text(0.5, 0.5, "none above 0", transform=panel.transAxes, ha="center")
        panel.set(xticks=[], yticks=[])
        return
    low, high = float(values.min()), float(values.max())
    wide = high > 3.0 * low
    if wide:
        edges = np.geomspace(low, high * 1.0001, _BINS + 1)
        panel.set_xscale("log")
    else:
        reach = max(high - low, 0.02 * high)
        edges = np.linspace(low - 0.02 * reach, high + 0.02 * reach, _BINS + 1)
        panel.ticklabel_format(axis="x", useOffset=False)
    panel.hist(values, edges.tolist(), color=style.KINDS[4], edgecolor="none")
    panel.set_yscale("log")  # the tail is what matters, and is a thousandth of the whole
    panel.set_ylim(bottom=0.7)
    marks: tuple[tuple[float, str, Any], ...] = (
        (float(np.median(values)), "median", "-"),
        (float(np.quantile(values, 0.99)), "p99", (0, (5, 1.5))),
        (high, "max", (0, (1, 1.2))),
    )
    for value, name, dash in marks:
        shown = f"{name} {value:,.0f}" if value >= 100.0 else f"{name} {value:.3g}"
        panel.axvline(value, color=style.INK, linestyle=dash, linewidth=0.9, label=shown)
    panel.legend(loc="upper right", handlelength=1.6, frameon=True, framealpha=1.0, edgecolor="w")
    panel.set_ylim(top=panel.get_ylim()[1] * 12.0)  # room for the legend


def _table(panel: Axes, stats: dict[str, Any]) -> None:
    panel.set_axis_off()
    parts = [each if isinstance(each := stats.get(part), dict) else {} for part in _PARTS]
    panel.table(
        [[_shown(times.get(share)) for share, _ in _SHARES] for times in parts],
        rowLabels=list(_PARTS),
        colLabels=[f"{title} [µs]" for _, title in _SHARES],
        loc="center",
        edges="horizontal",
    )
    ticks, overruns = stats.get("ticks"), stats.get("overruns")
    panel.set_title(f"all ticks since the daemon's start: {ticks} ticks, {overruns} overruns")


def _shown(value: object) -> str:
    if not isinstance(value, float) or not np.isfinite(value):
        return "—"
    return f"{value * 1e6:,.1f}"
