"""The page of errors: estimates of a simulated hand minus the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softfinger.tools import style
from softfinger.tools.analysis.plots_data import BoolArray, FloatArray, Missing, RecordedRun
from softfinger.tools.analysis.plots_model import DEGREES, LINES, time_axis, titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BINS = 41
_BAND = 800  # corners of a band of uncertainty, at most
# Title, field, factor to the unit shown, unit
_ROWS = (
    ("d", "d", 1e6, "µm"),
    ("θ", "theta", DEGREES, "°"),
    ("force F", "force", 1.0, "N"),
)


def draw_error(run: RecordedRun) -> Figure:
    """Estimate minus truth over time within ± 2σ as reported, and histograms."""
    run.need_states()
    if not run.truth:
        raise Missing("no hand/truth in it: only simulated hands publish it")
    at, true = run.matched()
    both = {
        name: run.touching(name)[at] & (run.truth[f"true_{name}.d"][true] > 0.0)
        for name in run.fingers
    }
    if not any(each.any() for each in both.values()):
        raise Missing("no contact in it")
    figure = style.new_figure(7.2, 7.6)
    axes = figure.subplots(4, 2, width_ratios=[3.4, 1.0], sharey="row", sharex="col")
    t = run.t[at]
    for panels, (title, field, factor, unit) in zip(axes, _ROWS, strict=False):
        entries = []
        for name, valid in both.items():
            key = f"{name}.{field}"
            error = (run.states[key][at] - run.truth[f"true_{key}"][true]) * factor
            entries.append((name, error, run.states[f"{key}_std"][at] * factor, valid))
        _row(panels, t, entries)
        panels[0].set_ylabel(f"error of {title} [{unit}]")
    error = (run.states["object.angle"][at] - run.truth["true_object.angle"][true]) * DEGREES
    valid = (run.states["object.valid"][at] > 0.0) & np.all(list(both.values()), axis=0)
    _row(axes[3], t, [("object", error, np.full(t.size, np.nan), valid)])
    axes[3, 0].set_ylabel("error of φ [°]")
    axes[3, 1].set_xlabel("share [%]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    more, names = axes[3, 0].get_legend_handles_labels()
    figure.legend(handles + more, labels + names, loc="outside lower center", ncols=5)
    titled(figure, run, "estimate minus truth; thin lines: ± 2σ as reported")
    figure.align_ylabels()
    time_axis(axes[3, 0], t)
    return figure


def _row(
    panels: tuple[Axes, Axes],
    t: FloatArray,
    entries: list[tuple[str, FloatArray, FloatArray, BoolArray]],
) -> None:
    """One quantity: name, error, reported σ and where both are valid, of each finger."""
    panel, side = panels
    known = [error[valid & np.isfinite(error)] for _, error, _, valid in entries]
    together = np.concatenate(known)
    if not together.size:
        return
    limit = 1.3 * float(np.quantile(np.abs(together), 0.995)) or 1e-12
    for k, (name, error, std, valid) in enumerate(entries):
        if not known[k].size:
            continue
        look = LINES.get(name, {"color": style.KINDS[2], "linestyle": "-"})
        colour = look["color"]
        panel.plot(t, np.where(valid, error, np.nan), label=name, linewidth=0.7, **look)
        text = f"{name}: mean {known[k].mean():.2g}, std {known[k].std():.2g}"
        if np.isfinite(std[valid]).any():
            times, band = _envelope(t, np.where(valid, 2.0 * std, np.nan))
            panel.fill_between(times, -band, band, color=colour, alpha=0.10, lw=0)
            for sign in (-1.0, 1.0):
                panel.plot(times, sign * band, color=colour, linewidth=0.6, alpha=0.8)
            inside = np.abs(error[valid]) <= 2.0 * std[valid]
            text += f", {100.0 * inside.mean():.1f} % within 2σ"
            limit = max(limit, 1.15 * float(np.nanquantile(2.0 * std[valid], 0.97)))
        panel.text(0.52 * k, 1.02, text, transform=panel.transAxes, fontsize=6.8, color=colour)
    for (name, *_), each in zip(entries, known, strict=True):
        if each.size:
            counts, edges = np.histogram(each, _BINS, (-limit, limit))
            look = LINES.get(name, {"color": style.KINDS[2]})
            side.stairs(100.0 * counts / each.size, edges, orientation="horizontal", **look)
    panel.set_ylim(-limit, limit)
    beyond = float((np.abs(together) > limit).mean())
    if beyond > 0.0:
        side.text(
            1.0,
            1.02,
            f"{100.0 * beyond:.2g} % beyond",
            transform=side.transAxes,
            fontsize=6.8,
            ha="right",
        )


def _envelope(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The largest of every few values, for a band that grows between frames; NaN where one is."""
    step = -(-t.size // _BAND)
    starts = np.arange(0, t.size, step)
    return t[starts], np.maximum.reduceat(values, starts)
