"""Represent a figure by data sheets, and by panels that plot the data."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.own_files import write_text
from softfinger.tools.style import INK, caption

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
Ends = tuple[float, float]

DEPTH = "displacement d [mm]"
RELATIVE = "relative angle θ [deg]"
CIRCLE: dict[str, Any] = {"marker": "o", "linestyle": "none", "mfc": "none"}
DOT = CIRCLE | {"ms": 3, "mec": INK, "mew": 0.6}


@dataclass(frozen=True)
class Sheet:
    """Columns of equal length with the keys ``quantity [unit]``; ``name`` is the file name.

    Values are strings or numbers. NaN is written as an empty cell. Dimensionless numbers have the
    unit 1, and strings have no unit.
    """

    name: str
    columns: Mapping[str, Any]

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return the values in column ``name``; raise KeyError if the column does not exist."""
        heads = {head.partition(" [")[0]: head for head in self.columns}
        return np.asarray(self.columns[heads[name]])

    def write(self, folder: Path) -> Path:
        """Write ``folder``/name.csv and return its path."""
        path = folder / f"{self.name}.csv"
        with write_text(path, newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.columns)
            for row in zip(*self.columns.values(), strict=True):
                writer.writerow([_cell(value) for value in row])
        return path


def summary(name: str, rows: Sequence[Mapping[str, Any]]) -> Sheet:
    """Build a sheet from rows with identical keys."""
    return Sheet(name, {head: [row[head] for row in rows] for head in rows[0]})


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.15g}"


@dataclass(frozen=True)
class Erratum:
    """Erratum in the paper, with its location, the printed statement and the correction."""

    place: str
    printed: str
    holds: str


@dataclass(frozen=True)
class Panel:
    """Axes in a figure, with a drawing function, labels, limits and a legend."""

    content: Callable[..., None]  # drawing function, called with the axes and all sheets
    xlabel: str
    ylabel: str
    title: str = ""
    x: Ends | None = None
    y: Ends | None = None
    legend: str | dict[str, Any] = ""  # legend location, or keyword arguments of `Axes.legend`

    def draw(self, axes: Axes, sheets: Sequence[Sheet]) -> None:
        self.content(axes, *sheets)
        axes.set(xlabel=self.xlabel, ylabel=self.ylabel, title=self.title)
        axes.set(**{name: ends for name, ends in (("xlim", self.x), ("ylim", self.y)) if ends})
        if self.legend:
            axes.legend(**{"loc": self.legend} if isinstance(self.legend, str) else self.legend)


@dataclass(frozen=True)
class FigurePage:
    """Figure from the paper, with data, panels and errata."""

    title: str
    size: tuple[float, float]  # inch
    sheets: Callable[[], tuple[Sheet, ...]]
    panels: tuple[Panel, ...]
    rows: int = 1
    # Keyword arguments for `matplotlib.figure.Figure.subplots`.
    layout: dict[str, Any] = field(default_factory=dict)
    errata: tuple[Erratum, ...] = ()
    notes: tuple[str, ...] = ()

    def draw(self, figure: Figure, sheets: Sequence[Sheet]) -> None:
        """Draw the title, panels, errata and notes."""
        figure.suptitle(self.title, fontsize=10)
        columns = len(self.panels) // self.rows
        every = figure.subplots(self.rows, columns, squeeze=False, **self.layout).ravel()
        for axes, panel in zip(every, self.panels, strict=True):
            panel.draw(axes, sheets)
        lines = [f"Erratum, {each.place}: {each.holds}" for each in self.errata]
        caption(figure, [*lines, *self.notes])


def errata_sheet(pages: dict[str, FigurePage]) -> Sheet:
    """Return a sheet with one row per erratum in ``pages``."""
    rows = [
        {"figure": name, "place in the paper": e.place, "printed": e.printed, "holds": e.holds}
        for name, page in pages.items()
        for e in page.errata
    ]
    return summary("errata", rows)
