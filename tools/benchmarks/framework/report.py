"""What a measurement returns: tables of rows; their text, their picture, and what became slower."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softfinger.tools import style

# One measured thing; each key is the heading of its column, "name" the first of them.
Row = dict[str, Any]

_IN_SECONDS = {"ns": 1e-9, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
_SURE = 3.0  # interquartile ranges, by which a median has to rise to be called slower
_LEAST = 0.05  # share below which no rise is of interest


@dataclass(frozen=True)
class Report:
    """Rows under a title; ``error`` names the column that run time is drawn against."""

    title: str
    rows: list[Row]
    error: str = ""
    notes: tuple[str, ...] = ()
    failed: bool = False

    def __str__(self) -> str:
        """Aligned text; numbers with four digits, nothing for None and NaN."""
        keys = list(dict.fromkeys(key for row in self.rows for key in row)) or ["name"]
        lines = [[self.title if key == "name" else key for key in keys]]
        lines += [[_cell(row.get(key)) for key in keys] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        words = [any(isinstance(row.get(key), str) for row in self.rows) for key in keys]
        aligned = [
            "  ".join(
                cell.ljust(width) if left else cell.rjust(width)
                for cell, width, left in zip(line, widths, words, strict=True)
            ).rstrip()
            for line in lines
        ]
        return "\n".join([*aligned, *self.notes])


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def figure(name: str, unit: str, samples: ArrayLike, aim: float | None = None) -> Row:
    """Median, interquartile range and 99th percentile of samples that are already in ``unit``."""
    values = np.asarray(samples, dtype=np.float64)
    low, median, high, p99 = np.percentile(values, [25.0, 50.0, 75.0, 99.0]).tolist()
    return {
        "name": name,
        "median": median,
        "IQR": high - low,
        "p99": p99,
        "unit": unit,
        "aim ≤": aim,
        "n": int(values.size),
    }


def yardstick() -> Row:
    """A fixed piece of work: how fast this machine is just now, to compare runs by."""
    samples = []
    for _ in range(101):
        before = time.perf_counter_ns()
        sum(i * i for i in range(2000))
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return figure("yardstick", "µs", samples)


def slower(old: list[Row], new: list[Row]) -> Report:
    """The times and ratios of ``new`` that rose beyond the noise of both runs.

    Rows are matched by measurement, table and name. Times are taken over their run's own yardstick,
    so that a slower machine makes nothing slower.
    """

    def by_key(rows: list[Row]) -> dict[tuple[str, str, str], Row]:
        chosen = [row for row in rows if row.get("unit") in {*_IN_SECONDS, "×"}]
        return {(row["measurement"], row["table"], row["name"]): row for row in chosen}

    before, after = by_key(old), by_key(new)
    rows = []
    common = [key for key in after if key[2] != "yardstick" and key in before]
    for key in common:
        row = after[key]
        if before[key]["median"] <= 0.0:
            continue
        ends = [before[key], row]
        if row["unit"] == "×":
            values = [end["median"] for end in ends]
        else:
            sticks = [each[key[0], "", "yardstick"] for each in (before, after)]
            pairs = zip(ends, sticks, strict=True)
            values = [e["median"] * _IN_SECONDS[e["unit"]] / s["median"] for e, s in pairs]
            ends += sticks
        noise = math.hypot(*(end["IQR"] / end["median"] for end in ends if end["median"] > 0.0))
        ratio = values[1] / values[0]
        if ratio > 1.0 + max(_SURE * noise, _LEAST):
            name = ": ".join(part for part in key if part)
            rows.append({"name": name, "ratio": ratio, "noise": noise})
    return Report(f"slower than before, over the yardstick: {len(rows)} of {len(common)}", rows)


def draw(tables: list[Report], path: Path) -> None:
    """Run time against error: a panel for each table with an error column. Raises MissingExtra."""
    drawn = [table for table in tables if table.error]
    columns = min(len(drawn), 3)
    rows = math.ceil(len(drawn) / columns)
    looks: dict[str, int] = {}  # of each kind, the same in all panels
    with style.settings():
        figure = style.new_figure(3.6 * columns + 0.8, 3.4 * rows + 0.6)
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(drawn) :]:
            axes.remove()
        for axes, table in zip(panels, drawn, strict=False):
            kinds: dict[str, list[Row]] = {}
            for row in table.rows:
                if "median" not in row:  # a bound
                    axes.axvline(row[table.error], color=style.GREY, linestyle="--", linewidth=1.0)
                elif row.get(table.error, math.nan) > 0.0:  # no NaN
                    kinds.setdefault(str(row["name"]).split(",")[0].split(":")[0], []).append(row)
            for kind, chosen in kinds.items():
                k = looks.setdefault(kind, len(looks))
                axes.plot(
                    [row[table.error] for row in chosen],
                    [row["median"] for row in chosen],
                    style.MARKERS[k % len(style.MARKERS)],
                    color=style.KINDS[k % len(style.KINDS)],
                    ms=5,
                    label=kind,
                )
            axes.set(
                xscale="log", yscale="log", title=table.title, xlabel=f"{table.error} (better →)"
            )
            axes.set_ylabel(f"run time [{table.rows[0]['unit']}]")
            axes.invert_xaxis()
            axes.legend(loc="best", fontsize=6)
        style.save(figure, path)
