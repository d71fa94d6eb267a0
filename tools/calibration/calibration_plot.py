"""Plot the result and residuals of one calibration step."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from softfinger.tools import style


class Map(NamedTuple):
    """Panel that shows one value per cell [rows, cols]."""

    title: str
    values: ArrayLike

    def draw(self, figure: Any, axes: Any) -> None:
        axes.grid(False)
        image = axes.imshow(self.values, origin="lower", cmap="viridis")
        axes.set(title=self.title, xlabel="column", ylabel="row")
        figure.colorbar(image, ax=axes, shrink=0.85)


class Points(NamedTuple):
    """Panel that shows measured ``y`` versus ``x``, and the fit if there is one."""

    title: str
    xlabel: str
    ylabel: str
    x: ArrayLike
    y: ArrayLike
    fit: ArrayLike | None = None

    def draw(self, _: Any, axes: Any) -> None:
        axes.plot(self.x, self.y, "o", ms=3, color=style.KINDS[0], label="measured")
        if self.fit is not None:
            axes.plot(self.x, self.fit, "x", ms=4, color=style.KINDS[1], label="fit")
            axes.legend()
        axes.set(title=self.title, xlabel=self.xlabel, ylabel=self.ylabel)


Panel = Map | Points


def draw(step: str, panels: tuple[Panel, ...], path: Path) -> None:
    """Write a figure for ``step`` with its panels side by side."""
    with style.settings():
        figure = style.new_figure(7.5, 3.4)
        figure.suptitle(f"Calibration: {step}", fontsize=10)
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels,
                               strict=True):  # fmt: skip
            panel.draw(figure, axes)
        style.save(figure, path)
