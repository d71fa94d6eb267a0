"""The picture of one calibration step: its result and residuals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.tools import style


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
    d, fit, model = data["d"], data["fit"], data["model"]
    left.plot(d * 1e3, data["force"], "o", color=style.KINDS[0], label="measured")
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


def _law(_: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    fits = data["fits"]
    names = [
        f"{tip.base}, {tip.face}" if tip.physics == "solid" else "springs"
        for tip in (each.tip for each in fits)
    ]
    for axes, values, title in (
        (left, [each.chi2 for each in fits], "χ² a cell"),
        (right, [100.0 * each.force_error for each in fits], "error left in F [%]"),
    ):
        axes.barh(names, values, color=style.KINDS[: len(fits)])
        axes.set(title=title)
    left.axvline(1.0, color=style.GREY)
    left.set(xscale="log")


def _relaxation(_: Any, left: Any, right: Any, data: dict[str, Any]) -> None:
    t, force, model = data["t"], data["force"], data["model"]
    left.plot(t, force, ".", ms=2, color=style.KINDS[0], label="measured")
    left.plot(t, model, color=style.INK, label="fit")
    left.set(xlabel="t [s]", ylabel="F [N]")
    left.legend()
    right.plot(t, force - model, ".", ms=2, color=style.KINDS[0])
    right.set(xlabel="t [s]", ylabel="measured − fit [N]")


_PANELS = {
    "tare": _tare,
    "equilibrate": _equilibrate,
    "curve": _curve,
    "centre": _centre,
    "modulus": _modulus,
    "law": _law,
    "relaxation": _relaxation,
}
