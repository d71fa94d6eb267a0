"""The page of the loop's times: histograms from the states, quantiles from ``hand/stats``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.tools import style
from softfinger.tools.analysis.plots_data import FloatArray, RecordedRun
from softfinger.tools.analysis.plots_time import titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        if high < 100.0 * low:  # else the decades are enough
            _name_ticks(panel, low, high)
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


def _name_ticks(panel: Axes, low: float, high: float) -> None:
    """Few round numbers on a logarithmic axis of less than two decades."""
    from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter

    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    parts = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0) if high < 4.0 * low else (1.0, 2.0, 5.0)
    round_numbers = np.concatenate([part * decades for part in parts])
    shown = np.sort(round_numbers[(round_numbers >= low) & (round_numbers <= high)])
    panel.xaxis.set_major_locator(FixedLocator(shown.tolist()))
    panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_minor_formatter(NullFormatter())


def _table(panel: Axes, stats: dict[str, Any]) -> None:
    panel.set_axis_off()
    rows = []
    for part in _PARTS:
        times = stats.get(part)
        known = times if isinstance(times, dict) else {}
        rows.append([_shown(known.get(share)) for share, _ in _SHARES])
    table = panel.table(
        rows,
        rowLabels=list(_PARTS),
        colLabels=[f"{title} [µs]" for _, title in _SHARES],
        loc="center",
        cellLoc="right",
        edges="horizontal",
    )
    table.auto_set_font_size(False)
    table.set_fontsize(7.5)
    for cell in table.get_celld().values():
        cell.set_linewidth(0.5)
    ticks, overruns = stats.get("ticks"), stats.get("overruns")
    panel.set_title(
        f"all ticks since the daemon's start: {ticks} ticks, {overruns} overruns", fontsize=8.0
    )


def _shown(value: object) -> str:
    if not isinstance(value, float) or not np.isfinite(value):
        return "—"
    return f"{value * 1e6:,.1f}"
