"""Figs. 7 and 10: the model's curves for the paper's two experiments.

The measured points are printed in the paper as pictures only and are not reproduced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from softfinger.kinematics.contact.closed_form import closed_forms
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.paper.model_pages import DEPTHS, MILLI, MODULUS, TILTS, TIP, Numbers
from softfinger.tools.paper.sheets import Erratum, FloatArray, Page, Sheet, sheet
from softfinger.tools.paper.style import GREY, INK, KINDS, caption, label_ends, ordered

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    """Force over displacement at each angle: the model, and what the sensor's cells sum to."""
    material = Material.constant(MODULUS)
    d = np.arange(81) / 10.0
    columns: list[tuple[str, str, FloatArray]] = [("d", "mm", d)]
    for tilt in TILTS:
        theta = np.float64(tilt)
        sensed = [
            np.sum(GRID.pressure(TIP, material, each * MILLI, np.radians(theta), 0.0)) * PITCH**2
            for each in d
        ]
        columns += [
            (f"F at {tilt} deg", "N", _force(d, theta)),
            (f"F through the sensor at {tilt} deg", "N", np.array(sensed)),
            (f"F of Table I's law at {tilt} deg", "N", _force_table_i(d, theta)),
        ]
    return (sheet("fig7", *columns),)


def draw_compression(figure: Figure, sheets: Sequence[Sheet]) -> None:
    """Panels (a) to (g), one an angle, and (h) with all of them."""
    (numbers,) = sheets
    panels = figure.subplots(2, 4, sharex=True, sharey=True).ravel()
    d = numbers["d"]
    styles = ordered(len(TILTS))
    for letter, axes, tilt in zip("abcdefg", panels, TILTS, strict=False):
        axes.plot(d, numbers[f"F at {tilt} deg"], color=KINDS[0], label="E = 0.304 MPa")
        axes.plot(
            d[::8],
            numbers[f"F through the sensor at {tilt} deg"][::8],
            "o",
            ms=4,
            mfc="none",
            mec=INK,
            label="through 44 × 44 cells",
        )
        axes.plot(
            d,
            numbers[f"F of Table I's law at {tilt} deg"],
            "--",
            color=KINDS[1],
            label="Table I's law",
        )
        axes.set_title(f"({letter}) {tilt}°")
    last = panels[-1]
    ends = []
    for tilt, style in zip(TILTS, styles, strict=True):
        last.plot(d, numbers[f"F at {tilt} deg"], **style)
        ends.append(float(numbers[f"F at {tilt} deg"][-1]))
    last.set(title="(h) all", xlim=(0, 8.3), ylim=(0, 82), xticks=range(0, 9, 2))
    label_ends(last, 8.0, ends, [f"{tilt}°" for tilt in TILTS], gap=0.07)
    for axes in panels[4:]:
        axes.set_xlabel("displacement d [mm]")
    for axes in panels[::4]:
        axes.set_ylabel("total elastic force F [N]")
    panels[0].legend(loc="upper left")
    _caption(figure, "fig7")


def tilt_and_roll() -> tuple[Sheet, ...]:
    """The path of the relative angle: the finger tilts about its root, then the object rolls.

    Rotation, at each final displacement D: a root at the distance D/sin 11.5° from the tip's centre
    makes d rise from first touch as D sin |θ|/sin 11.5°. Rolling: d stays D.
    """
    tilting = -np.arange(0, 116) / 10.0
    rolling = np.arange(-115, 93) / 10.0
    rise = np.sin(np.radians(tilting)) / np.sin(np.radians(TILTED))
    first: list[tuple[str, str, FloatArray]] = [("theta", "deg", tilting)]
    second: list[tuple[str, str, FloatArray]] = [("theta", "deg", rolling)]
    for deepest in DEPTHS:
        d = np.float64(deepest)
        first += [
            (f"d up to {deepest} mm", "mm", d * rise),
            (f"F, d up to {deepest} mm", "N", _force(d * rise, tilting)),
            (f"F at d = {deepest} mm", "N", _force(d, tilting)),
        ]
        force, law = _force(d, rolling), _force_table_i(d, rolling)
        # Springs that point at the tip's centre (Nguyen and Arimoto): N = πE d², whatever the tilt.
        radial = np.full(rolling.shape, math.pi * MODULUS * (d * MILLI) ** 2)
        second += [
            (f"F at d = {deepest} mm", "N", force),
            (f"F/F(0) at d = {deepest} mm", "1", force / force[rolling == 0.0]),
            (f"F of Table I's law at d = {deepest} mm", "N", law),
            (f"F/F(0) of Table I's law at d = {deepest} mm", "1", law / law[rolling == 0.0]),
            (f"F of radial springs at d = {deepest} mm", "N", radial),
        ]
    return sheet("fig10a", *first), sheet("fig10b", *second)


def draw_tilt_and_roll(figure: Figure, sheets: Sequence[Sheet]) -> None:
    """(a) the rotation, in newton; (b) the rolling, over the force at 0°."""
    rotation, rolling = sheets
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
    theta = rotation["theta"]
    ends = []
    for d, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        force = rotation[f"F, d up to {d} mm"]
        left.plot(theta, force, **style)
        left.plot(theta, rotation[f"F at d = {d} mm"], color=GREY, linewidth=0.7)
        ends.append(float(force[-1]))
    left.invert_xaxis()
    left.set(
        xlabel="relative angle θ [deg]",
        ylabel="total elastic force F [N]",
        title="(a) the finger rotates",
        xlim=(0, TILTED),
        ylim=(0, 76),
    )
    label_ends(left, TILTED, ends, [f"to {d} mm" for d in DEPTHS], gap=0.06)
    left.plot([], [], "-", color=INK, label="d rises from first touch")
    left.plot([], [], "-", color=GREY, linewidth=0.7, label="d held at its last value")
    left.legend(loc="upper left")

    theta = rolling["theta"]
    ratio = rolling["F/F(0) at d = 4 mm"]
    right.plot(theta, ratio, color=INK, label="constant E, every d: 1/cos θ")
    for d, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        law = rolling[f"F/F(0) of Table I's law at d = {d} mm"]
        if d in (DEPTHS[0], DEPTHS[-1]):
            right.plot(
                theta, law, **(style | {"linewidth": 1.1}), label=f"Table I's law, d = {d} mm"
            )
    radial = rolling["F of radial springs at d = 4 mm"]
    right.plot(
        theta,
        radial / radial[theta == 0.0],
        color=KINDS[1],
        linestyle=":",
        label="radial springs: flat",
    )
    right.plot(0.0, 1.0, "v", ms=7, color=INK, label="minimum at 0°")
    for x, side in ((TILTED, "right"), (ROLLED, "left")):
        value = float(ratio[np.argmin(np.abs(theta - x))])
        right.plot(x, value, "o", ms=4.5, color=INK)
        right.annotate(
            f"{x:g}°: {value:.4f}".replace("-", "−"),
            (x, value),
            (6 if side == "left" else -6, -3),
            textcoords="offset points",
            ha=side,
            fontsize=7.5,
        )
    right.annotate(
        "", (4.2, 1.0135), (-4.8, 1.0135), arrowprops={"arrowstyle": "->", "lw": 0.8, "color": GREY}
    )
    right.text(-0.3, 1.0140, "the object rolls", ha="center", fontsize=7.5, color=GREY)
    right.set(
        xlabel="relative angle θ [deg]",
        ylabel="F(θ)/F(0) at equal d",
        title="(b) then the object rolls by 20.7°",
        xlim=(-24, 18),
        ylim=(0.9975, 1.038),
    )
    right.legend(loc="upper center", ncols=2, columnspacing=1.0)
    _caption(figure, "fig10")


def _caption(figure: Figure, name: str) -> None:
    page = PAGES[name]
    lines = [f"Erratum, {each.place}: {each.holds}" for each in page.errata]
    caption(figure, [*lines, *page.notes])


PAGES = {
    "fig7": Page(
        title="Fig. 7: translational contact, force over the displacement at each angle",
        size=(7.6, 5.2),
        sheets=compression,
        draw=draw_compression,
        errata=(
            Erratum(
                "IV-A",
                "the elastic force is proportional to the over-square of the displacement, also in "
                "experiments",
                "the model's exponent is exactly 2 at every angle, its prefactor 1/cos θ; only a "
                "modulus that rises with strain gives more.",
            ),
        ),
        notes=(
            "Sensor: 44 × 44 cells on 58 mm × 58 mm, each averaging the pressure over its area. "
            "The paper's measured points, off by a near-constant amount, are not reproduced.",
        ),
    ),
    "fig10": Page(
        title="Fig. 10: rotational and rolling contact",
        size=(7.6, 4.3),
        sheets=tilt_and_roll,
        draw=draw_tilt_and_roll,
        notes=(
            "Negative angles are those that the finger's rotation makes. The paper gives neither d "
            "nor the distance of the finger's root: four depths are shown, and in (a) d grows from "
            "first touch at 0° as sin |θ|. The measured forces, off by about 17 % in (b) and least "
            "slightly before 0°, are not reproduced.",
        ),
    ),
}
