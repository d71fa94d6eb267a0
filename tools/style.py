"""Plot style: sizes for print, and lines that can be distinguished without colour.

An ordered family of lines, e.g. by displacement or angle, uses colours of decreasing lightness. The
order remains visible in greyscale and for colour-blind readers. Each line also has its own dash
pattern. Unordered categories use the Okabe-Ito palette.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from softfinger.daemon.own_files import write_bytes
from softfinger.tools.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = TypeVar("Value")

DPI = 200
GREY = "#707070"
INK = "#202020"
KINDS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")
_DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (1.2, 1.2)),
    (0, (8, 2, 2, 2)),
    (0, (3, 1.2, 1, 1.2, 1, 1.2)),
    (0, (2.5, 2.5)),
)
_SETTINGS: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.labelsize": 8.5,
    "legend.fontsize": 7.5,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def settings() -> AbstractContextManager[None]:
    """Return a context manager for this style; raise MissingExtra if matplotlib is missing."""
    require("plot")
    import matplotlib

    return matplotlib.rc_context(_SETTINGS)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of the given size [inch] that does not require a window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write the figure in the format given by the path suffix."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=DPI, format=path.suffix.removeprefix(".") or None)
    with write_bytes(path) as file:
        file.write(picture.getbuffer())


def ordered(values: Sequence[Value]) -> list[tuple[Value, dict[str, Any]]]:
    """Pair each value with the colour and dashes of its line; the first is a light solid line."""
    import matplotlib

    shades = matplotlib.colormaps["viridis"](np.linspace(0.72, 0.0, len(values)))
    lines = zip(values, shades, itertools.cycle(_DASHES), strict=False)
    return [(value, {"color": shade, "linestyle": dashes}) for value, shade, dashes in lines]


def caption(figure: Figure, lines: Sequence[str]) -> None:
    """Write notes below the panels, wrapped to the figure width."""
    import textwrap

    columns = int(figure.get_figwidth() * 17.5)
    text = "\n".join(textwrap.fill(line, columns) for line in lines)
    figure.supxlabel(text, x=0.01, ha="left", fontsize=7.5, color=INK)
