"""The picture of one calibration step: its result and residuals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.tools.paper import style


def draw(step: str, data: dict[str, Any], path: Path) -> None:
    """Write the picture of ``step``; ``data`` as that step returns it."""
    with style.settings():
        figure = style.new_figure(7.5, 3.4)
        figure.suptitle(f"Calibration: {step}", fontsize=10)
        left, right = figure.subplots(1, 2)
        _PANELS[step](figure, left, right, data)
        style.save(figure, path)


def _map(figure: Any, axes: Any, values: Any, title: str) -> None:
    axes.grid(False)
    image = axes.imshow(values, origin="lower", cmap="viridis")
    axes.set(title=title, xlabel="column", ylabel="row")
    figure.colorbar(image, ax=axes, shrink=0.85)


def _tare(figure: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    _map(figure, left, data["zero"], "zero [counts]")
    _map(figure, right, data["noise"], "noise, standard deviation [counts]")


def _equilibrate(figure: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    gain = data["gain"]
    _map(figure, left, gain, "gain of each cell, 0: dead")
    right.hist(gain[gain > 0.0], bins=40, color=style.KINDS[0])
    right.set(title="live cells", xlabel="gain", ylabel="cells")


def _curve(_: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    force, errors = data["force"], np.asarray(data["errors"])
    left.plot(force, force * (1.0 + errors), "o", color=style.KINDS[0])
    left.plot(force, force, "-", color=style.GREY)
    left.set(title="forces", xlabel="known [N]", ylabel="by the sensor [N]")
    right.plot(force, 100.0 * errors, "o", color=style.KINDS[1])
    right.set(title="residuals", xlabel="known force [N]", ylabel="relative error [%]")


def _centre(_: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    found, theta = data["centre"], np.degrees(data["theta"])
    left.plot(0.0, 0.0, "+", color=style.GREY, ms=12, label="middle of the grid")
    left.plot(found.centre[0] * 1e3, found.centre[1] * 1e3, "o", color=style.KINDS[0], label="tip")
    if found.rotation is not None:
        c, s = math.cos(found.rotation), -math.sin(found.rotation)
        left.annotate(
            "finger's x",
            xy=((found.centre[0]) * 1e3 + 2 * c, found.centre[1] * 1e3 + 2 * s),
            xytext=(found.centre[0] * 1e3, found.centre[1] * 1e3),
            arrowprops={"arrowstyle": "->"},
        )
    left.set(title="on the sensor", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    left.legend()
    right.hist(theta, bins=20, color=style.KINDS[0])
    right.set(title=f"presses; {found.residual * 1e6:.0f} µm rms residual", xlabel="tilt [°]")


def _modulus(_: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    d, theta, fit = data["d"], data["theta"], data["fit"]
    left.plot(d * 1e3, data["force"], "o", color=style.KINDS[0], label="measured")
    model = math.pi * fit.modulus * np.maximum(d - fit.offset, 0.0) ** 2 / np.cos(theta)
    left.plot(d * 1e3, model, "x", color=style.KINDS[1], label="constant E")
    left.set(title=f"E = {fit.modulus / 1e6:.4f} MPa", xlabel="d [mm]", ylabel="force [N]")
    left.legend()
    strain, stress = data["law"]
    if strain:
        right.plot(np.array(strain) * 100, np.array(stress) / 1e3, "o-", color=style.KINDS[2])
        right.set(title="law", xlabel="strain [%]", ylabel="stress [kPa]")
    else:
        right.plot(d * 1e3, data["force"] / np.maximum(model, 1e-12) * 100 - 100, "o",
                   color=style.KINDS[1])  # fmt: skip
        right.set(title="residuals", xlabel="d [mm]", ylabel="relative error [%]")


_PANELS = {
    "tare": _tare,
    "equilibrate": _equilibrate,
    "curve": _curve,
    "centre": _centre,
    "modulus": _modulus,
}
