"""The picture of a run: medians against error or size, or bars, a panel for each table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.tools import style
from softfinger.tools.benchmarks.measuring import Report, Row, by_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST = 46  # characters of a bar's name


def draw(reports: list[Report], path: Path) -> None:
    """Draw a panel for each of ``reports``. Raises MissingExtra without matplotlib."""
    columns = min(len(reports), 3)
    heights = [
        max(3.5 if each.x else 1.1 + 0.24 * len(each.rows) for each in reports[k : k + columns])
        for k in range(0, len(reports), columns)
    ]
    looks: dict[str, int] = {}  # of each kind, the same in all panels
    with style.settings():
        from matplotlib.ticker import NullFormatter

        figure = style.new_figure(4.2 * columns + 0.6, sum(heights) + 0.4)
        grid = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights)
        panels = grid.ravel()
        for axes in panels[len(reports) :]:
            axes.remove()
        for axes, report in zip(panels, reports, strict=False):
            axes.set_title(report.title)
            if report.x:
                _points(axes, report, looks)
            else:
                _bars(axes, report.rows)
            for axis in (axes.xaxis, axes.yaxis):  # within a decade they would run together
                axis.set_minor_formatter(NullFormatter())
        style.save(figure, path)


def _points(axes: Axes, report: Report, looks: dict[str, int]) -> None:
    """Run time against ``report.x``; a row without a median is a bound of it."""
    x = report.x
    for row in report.rows:
        if "median" not in row:
            axes.axvline(row[x], color=style.GREY, linestyle="--", linewidth=1.0)
    for kind, found in by_kind(report.rows).items():
        chosen = [row for row in found if row.get(x, math.nan) >= 0.0]  # no NaN
        if not chosen:
            continue
        k = looks.setdefault(kind, len(looks))
        axes.plot(
            [row[x] for row in chosen],
            [row["median"] for row in chosen],
            linestyle="-" if report.grows else "none",
            marker=style.MARKERS[k % len(style.MARKERS)],
            color=style.KINDS[k % len(style.KINDS)],
            ms=4,
            label=kind,
        )
    shown = [row for row in report.rows if row.get(x) is not None and "median" in row]
    axes.set(xscale=_scale([row[x] for row in shown]), xlabel=x)
    axes.set(yscale=_scale([row["median"] for row in shown]), ylabel=f"[{shown[0]['unit']}]")
    if not report.grows:
        axes.set_xlabel(f"{x} (better →)")
        axes.invert_xaxis()
    axes.legend(loc="best", fontsize=6)


def _bars(axes: Axes, rows: list[Row]) -> None:
    """Medians, with a tick at the 99th percentile of many samples."""
    for k, row in enumerate(rows):
        axes.barh(k, row["median"], color=style.KINDS[0], height=0.6)
        if row["n"] >= 100:
            axes.plot(row["p99"], k, "|", color=style.INK, ms=9, mew=1.5)
        end = max(row["median"], row["p99"]) if row["n"] >= 100 else row["median"]
        axes.annotate(f"  {row['median']:.3g}", (end, k), va="center", fontsize=6)
    names = [str(row["name"]) for row in rows]
    short = [name if len(name) <= _LONGEST else name[: _LONGEST - 1] + "…" for name in names]
    axes.set_yticks(range(len(rows)), short, fontsize=6)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    tails = any(row["n"] >= 100 for row in rows)
    axes.set_xlabel(f"median{' and 99th percentile' if tails else ''} [{rows[0]['unit']}]")
    axes.set_xscale(_scale([row[key] for row in rows for key in ("median", "p99")]))
    axes.margins(x=0.15)  # for the last figure


def _scale(values: list[float]) -> str:
    """Logarithmic from a decade on."""
    return "log" if 0.0 < 10.0 * min(values) < max(values) else "linear"
