"""Sheets of numbers, each of which becomes one CSV file, and what a page of figures is."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.daemon.wire.own_files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """A named column in ``unit``; texts, or numbers of which NaN is written as an empty cell."""

    name: str
    unit: str
    values: NDArray[Any]

    @property
    def header(self) -> str:
        """Name and unit; 1 stands for a number without one, and texts have none."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class Sheet:
    """Columns of equal length under the name of their file."""

    name: str
    columns: tuple[Column, ...]

    def __getitem__(self, name: str) -> NDArray[Any]:
        """The values of the column called ``name``. Raises KeyError when there is none."""
        for column in self.columns:
            if column.name == name:
                return column.values
        raise KeyError(name)

    def write(self, folder: Path) -> Path:
        """Write ``folder``/name.csv, one header line with units; returns its path."""
        path = folder / f"{self.name}.csv"
        with write_text(path, newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow([column.header for column in self.columns])
            for row in zip(*(column.values for column in self.columns), strict=True):
                writer.writerow([_cell(value) for value in row])
        return path


def sheet(name: str, *columns: tuple[str, str, ArrayLike]) -> Sheet:
    """A sheet from (name, unit, values) of each column."""
    return Sheet(name, tuple(Column(title, unit, np.asarray(v)) for title, unit, v in columns))


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.15g}"


@dataclass(frozen=True)
class Erratum:
    """Where the paper errs: the place, what is printed there, and what holds."""

    place: str
    printed: str
    holds: str


@dataclass(frozen=True)
class Page:
    """One figure: its numbers, how they are drawn, and what in the paper's version is mistaken."""

    title: str
    size: tuple[float, float]  # [inch]
    sheets: Callable[[], tuple[Sheet, ...]]
    draw: Callable[[Figure, Sequence[Sheet]], None]
    errata: tuple[Erratum, ...] = ()
    notes: tuple[str, ...] = ()


def errata_sheet(pages: dict[str, Page]) -> Sheet:
    """The errata of these pages, one a row."""
    rows = [(name, each) for name, page in pages.items() for each in page.errata]
    return sheet(
        "errata",
        ("figure", "", [name for name, _ in rows]),
        ("place in the paper", "", [each.place for _, each in rows]),
        ("printed", "", [each.printed for _, each in rows]),
        ("holds", "", [each.holds for _, each in rows]),
    )
