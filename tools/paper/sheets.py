"""Figures as data: sheets of numbers, each a CSV file, and the panels drawn from them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.daemon.own_files import write_text
from softfinger.tools.style import INK, caption

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
Ends = tuple[float, float]

DEPTH = "displacement d [mm]"
FORCE = "total elastic force F [N]"
RELATIVE = "relative angle θ [deg]"
CIRCLE: dict[str, Any] = {"marker": "o", "linestyle": "none", "mfc": "none"}
DOT = CIRCLE | {"ms": 3, "mec": INK, "mew": 0.6}


@dataclass(frozen=True)
class Sheet:
    """Columns of equal length under the name of their file: (name, unit, values) of each.

    Values are texts, or numbers of which NaN is written as an empty cell. The unit 1 is that of a
    number without one; texts have none.
    """

    name: str
    columns: tuple[tuple[str, str, NDArray[Any]], ...]

    def __getitem__(self, name: str) -> NDArray[Any]:
        """The values of the column called ``name``. Raises KeyError when there is none."""
        return {title: values for title, _, values in self.columns}[name]

    def write(self, folder: Path) -> Path:
        """Write ``folder``/name.csv, one header line with units; returns its path."""
        path = folder / f"{self.name}.csv"
        with write_text(path, newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(
                [f"{name} [{unit}]" if unit else name for name, unit, _ in self.columns]
            )
            for row in zip(*(values for _, _, values in self.columns), strict=True):
                writer.writerow([_cell(value) for value in row])
        return path


def sheet(name: str, *columns: tuple[str, str, ArrayLike]) -> Sheet:
    """Return a sheet from (name, unit, values) of each column."""
    return Sheet(name, tuple((title, unit, np.asarray(v)) for title, unit, v in columns))


def summary(name: str, columns: Sequence[tuple[str, str]], rows: ArrayLike) -> Sheet:
    """Return a sheet of numbers from (name, unit) of each column and its rows."""
    values = np.asarray(rows, dtype=np.float64).T
    return sheet(name, *((*column, each) for column, each in zip(columns, values, strict=True)))


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.15g}"


@dataclass(frozen=True)
class Erratum:
    """Error of the paper: the place, the printed statement, and the correct one."""

    place: str
    printed: str
    holds: str


@dataclass(frozen=True)
class Panel:
    """Axes of a figure: what draws into them from the page's sheets, and the words around it."""

    content: Callable[..., None]  # of axes and sheets
    xlabel: str
    ylabel: str
    title: str = ""
    x: Ends | None = None
    y: Ends | None = None
    legend: str | dict[str, Any] = ""  # its place, or more of matplotlib's words

    def draw(self, axes: Axes, sheets: Sequence[Sheet]) -> None:
        self.content(axes, *sheets)
        axes.set(xlabel=self.xlabel, ylabel=self.ylabel, title=self.title)
        axes.set(**{name: ends for name, ends in (("xlim", self.x), ("ylim", self.y)) if ends})
        if self.legend:
            axes.legend(**{"loc": self.legend} if isinstance(self.legend, str) else self.legend)


@dataclass(frozen=True)
class FigurePage:
    """One figure: its numbers, its panels, and what in the paper's version is mistaken."""

    title: str
    size: tuple[float, float]  # [inch]
    sheets: Callable[[], tuple[Sheet, ...]]
    panels: tuple[Panel, ...]
    rows: int = 1
    layout: dict[str, Any] = field(default_factory=dict)  # of matplotlib's subplots
    errata: tuple[Erratum, ...] = ()
    notes: tuple[str, ...] = ()

    def draw(self, figure: Figure, sheets: Sequence[Sheet]) -> None:
        """Draw title, panels, errata and notes."""
        figure.suptitle(self.title, fontsize=10)
        columns = len(self.panels) // self.rows
        every = figure.subplots(self.rows, columns, squeeze=False, **self.layout).ravel()
        for axes, panel in zip(every, self.panels, strict=True):
            panel.draw(axes, sheets)
        lines = [f"Erratum, {each.place}: {each.holds}" for each in self.errata]
        caption(figure, [*lines, *self.notes])


def errata_sheet(pages: dict[str, FigurePage]) -> Sheet:
    """Return the errata of these pages, one a row."""
    rows = [(name, each) for name, page in pages.items() for each in page.errata]
    return sheet(
        "errata",
        ("figure", "", [name for name, _ in rows]),
        ("place in the paper", "", [each.place for _, each in rows]),
        ("printed", "", [each.printed for _, each in rows]),
        ("holds", "", [each.holds for _, each in rows]),
    )
