"""The picture of `softfinger bench --plot`: run time against error, one panel a table."""

from __future__ import annotations

import math
from pathlib import Path

from softfinger.tools.benchmarks.framework.report import Row, Table
from softfinger.tools.paper import style


def draw(tables: list[Table], path: Path) -> None:
    """Draw the tables that have an error column. Raises MissingExtra without the extra ``plot``."""
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
