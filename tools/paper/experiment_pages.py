"""Figs. 7 and 10: the model's curves for the paper's two experiments.

The measured points are printed in the paper as pictures only and are not reproduced.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.kinematics.contact.closed_form import closed_forms
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, MODULUS, TILTS, TIP, Numbers
from softfinger.tools.paper.sheets import (
    CIRCLE,
    DEPTH,
    FORCE,
    RELATIVE,
    Erratum,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
)
from softfinger.tools.style import GREY, INK, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PITCH = 0.058 / 44  # [m]
GRID = SensorGrid(rows=44, cols=44, pitch=PITCH)

TILTED = -11.5  # relative angle [deg] at the end of the finger's rotation
ROLLED = 9.2  # and at the end of the object's rolling, 20.7° on


def _force(d: Numbers, theta: Numbers) -> FloatArray:
    """F [N] for the paper's constant modulus; d in mm, θ in degrees."""
    return closed_forms(MODULUS, d * MILLI, np.radians(theta)).force


def _force_table_i(d: Numbers, theta: Numbers) -> FloatArray:
    """F [N] for the law through Table I; d in mm, θ in degrees."""
    return integrate(TIP, Material.table_i(), d * MILLI, np.radians(theta)).force


def compression() -> tuple[Sheet, ...]:
    """Tabulate force over displacement at each angle: the model and the sum of the cells."""
    material = Material.constant(MODULUS)
    d = np.arange(81) / 10.0
    columns = {"d [mm]": d}
    for tilt in TILTS:
        theta = np.float64(tilt)
        sensed = [
            np.sum(GRID.pressure(TIP, material, each * MILLI, np.radians(theta), 0.0)) * PITCH**2
            for each in d
        ]
        columns |= {
            f"F at {tilt} deg [N]": _force(d, theta),
            f"F through the sensor at {tilt} deg [N]": np.array(sensed),
            f"F of Table I's law at {tilt} deg [N]": _force_table_i(d, theta),
        }
    return (Sheet("fig7", columns),)


def _one_tilt(tilt: int, axes: Axes, numbers: Sheet) -> None:
    d = numbers["d"]
    axes.plot(d, numbers[f"F at {tilt} deg"], color=KINDS[0], label="E = 0.304 MPa")
    sensed = numbers[f"F through the sensor at {tilt} deg"]
    axes.plot(d[::8], sensed[::8], **CIRCLE | {"ms": 4, "mec": INK}, label="through 44 × 44 cells")
    law = numbers[f"F of Table I's law at {tilt} deg"]
    axes.plot(d, law, linestyle="--", color=KINDS[1], label="Table I's law")


def _all_tilts(axes: Axes, numbers: Sheet) -> None:
    for tilt, style in zip(TILTS, ordered(len(TILTS)), strict=True):
        axes.plot(numbers["d"], numbers[f"F at {tilt} deg"], **style, label=f"{tilt}°")


def _compression_panels() -> Iterator[Panel]:
    """Panels (a) to (g), one an angle, and (h) with all of them."""
    for k, (letter, tilt) in enumerate(zip("abcdefg", TILTS, strict=True)):
        labels = DEPTH if k >= 4 else "", "" if k % 4 else FORCE
        place = "" if k else "upper left"
        yield Panel(partial(_one_tilt, tilt), *labels, f"({letter}) {tilt}°", legend=place)
    legend = {"loc": "upper left", "ncols": 2}
    yield Panel(_all_tilts, DEPTH, "", "(h) all", (0, 8.3), (0, 82), legend)


def tilt_and_roll() -> tuple[Sheet, ...]:
    """Return path of the relative angle: the finger tilts about its root, then the object rolls.

    Rotation, at each final displacement D: a root at the distance D/sin 11.5° from the tip's centre
    makes d rise from first touch as D sin |θ|/sin 11.5°. Rolling: d stays D.
    """
    tilting = -np.arange(0, 116) / 10.0
    rolling = np.arange(-115, 93) / 10.0
    rise = np.sin(np.radians(tilting)) / np.sin(np.radians(TILTED))
    first, second = {"theta [deg]": tilting}, {"theta [deg]": rolling}
    for deepest in DEPTHS:
        d = np.float64(deepest)
        first |= {
            f"d up to {deepest} mm [mm]": d * rise,
            f"F, d up to {deepest} mm [N]": _force(d * rise, tilting),
            f"F at d = {deepest} mm [N]": _force(d, tilting),
        }
        force, law = _force(d, rolling), _force_table_i(d, rolling)
        # Springs that point at the tip's centre (Nguyen and Arimoto): N = πE d² at any tilt.
        radial = np.full(rolling.shape, math.pi * MODULUS * (d * MILLI) ** 2)
        second |= {
            f"F at d = {deepest} mm [N]": force,
            f"F/F(0) at d = {deepest} mm [1]": force / force[rolling == 0.0],
            f"F of Table I's law at d = {deepest} mm [N]": law,
            f"F/F(0) of Table I's law at d = {deepest} mm [1]": law / law[rolling == 0.0],
            f"F of radial springs at d = {deepest} mm [N]": radial,
        }
    return Sheet("fig10a", first), Sheet("fig10b", second)


def _rotation(axes: Axes, rotation: Sheet, _: Sheet) -> None:
    thin: dict[str, Any] = {"color": GREY, "linewidth": 0.7}
    for d, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        axes.plot(
            rotation["theta"], rotation[f"F, d up to {d} mm"], **style, label=f"d up to {d} mm"
        )
        axes.plot(rotation["theta"], rotation[f"F at d = {d} mm"], **thin)
    axes.plot([], [], color=INK, label="d rises from first touch")
    axes.plot([], [], **thin, label="d held at its last value")


def _rolling(axes: Axes, _: Sheet, rolling: Sheet) -> None:
    theta = rolling["theta"]
    axes.plot(theta, rolling["F/F(0) at d = 4 mm"], color=INK, label="constant E, every d: 1/cos θ")
    for d, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        if d in (DEPTHS[0], DEPTHS[-1]):
            law = rolling[f"F/F(0) of Table I's law at d = {d} mm"]
            axes.plot(theta, law, **style | {"linewidth": 1.1}, label=f"Table I's law, d = {d} mm")
    radial = rolling["F of radial springs at d = 4 mm"]
    axes.plot(theta, radial / radial[theta == 0.0], ":", color=KINDS[1], label="radial springs")
    for x, marker in ((TILTED, "o"), (0.0, "v"), (ROLLED, "s")):
        ratio = float(rolling["F/F(0) at d = 4 mm"][np.argmin(np.abs(theta - x))])
        label = f"{x:g}°: {ratio:.4f}".replace("-", "−")
        axes.plot(x, ratio, marker, ms=5, color=INK, label=label)


PAGES = {
    "fig7": FigurePage(
        "Fig. 7: translational contact, force over the displacement at each angle",
        (7.6, 5.2),
        compression,
        tuple(_compression_panels()),
        rows=2,
        layout={"sharex": True, "sharey": True},
        errata=(
            Erratum(
                "IV-A",
                "the elastic force is proportional to the over-square of the displacement, also in "
                "experiments",
                "the model's exponent is exactly 2 at every angle, its prefactor 1/cos θ; only a "
                "modulus that rises with strain gives more.",
            ),
            Erratum(
                "IV-A",
                "an approximately constant error over d, which a higher modulus brings close",
                "springs of any one E press with πE d²/cos θ: another E changes F by a share, "
                "never by a constant over d.",
            ),
        ),
        notes=(
            "Sensor: 44 × 44 cells on 58 mm × 58 mm, each averaging the pressure over its area. "
            "The paper's measured points, off by a near-constant amount, are not reproduced.",
        ),
    ),
    "fig10": FigurePage(
        "Fig. 10: rotational and rolling contact",
        (7.6, 4.3),
        tilt_and_roll,
        (
            Panel(_rotation, RELATIVE, FORCE, "(a) the finger rotates", (0, TILTED), (0, 76),
                  "upper left"),
            Panel(_rolling, RELATIVE, "F(θ)/F(0) at equal d", "(b) then the object rolls by 20.7°",
                  (-24, 18), (0.9975, 1.038),
                  {"loc": "upper center", "ncols": 2, "columnspacing": 1.0}),
        ),
        layout={"width_ratios": (1.0, 1.25)},
        notes=(
            "Negative angles are those that the finger's rotation makes. The paper gives neither d "
            "nor the distance of the finger's root: four depths are shown, and in (a) d grows from "
            "first touch at 0° as sin |θ|. The measured forces, off by about 17 % in (b) and least "
            "slightly before 0°, are not reproduced.",
        ),
    ),
}  # fmt: skip
