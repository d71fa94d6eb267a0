"""Figs. 4 and 5: force and energy over the tilt and over the displacement, for the paper's tip.

Lines are the closed forms; markers are the paper's double integrals, evaluated numerically.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from softfinger.kinematics.contact.closed_form import Fingertip, closed_forms
from softfinger.kinematics.contact.material import TABLE_I_MAXIMUM
from softfinger.tools.paper.integrals import double_integrals
from softfinger.tools.paper.sheets import Erratum, FloatArray, Page, Sheet, sheet
from softfinger.tools.paper.style import GREY, INK, caption, label_ends, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TIP = Fingertip(radius=0.020)
MODULUS = TABLE_I_MAXIMUM  # the paper's choice [Pa]
MILLI = 1e-3

Numbers = FloatArray | np.float64

DEPTHS = (2, 4, 6, 8)  # mm
TILTS = (0, 5, 10, 15, 20, 25, 30)  # degrees


@dataclass(frozen=True)
class Quantity:
    """Force or energy, as the figures name it."""

    symbol: str
    label: str
    unit: str
    scale: float  # from SI to the unit
    row: int  # in closed_forms and double_integrals
    exponent: int
    equation: int
    power: str  # of the displacement at θ = 0
    prefactor: str
    straight: float  # the power's factor over E

    def closed(self, d: Numbers, theta: Numbers) -> FloatArray:
        """Closed form in the figure's unit; d in mm, θ in degrees."""
        forms = closed_forms(MODULUS, d * MILLI, np.radians(theta))
        return (forms.force, forms.energy)[self.row] * self.scale

    def integral(self, d: Numbers, theta: Numbers) -> FloatArray:
        """The paper's double integral in the figure's unit; d in mm, θ in degrees."""
        pair = double_integrals(TIP.radius, MODULUS, d * MILLI, np.radians(theta))
        return pair[self.row] * self.scale

    def at_zero_tilt(self, d: Numbers) -> FloatArray:
        """The paper's continuous line: πEd² or πEd³/3, in the figure's unit; d in mm."""
        return self.straight * MODULUS * np.asarray(d * MILLI) ** self.exponent * self.scale


FORCE = Quantity("F", "total elastic force", "N", 1.0, 0, 2, 3, "πEd²", "1/cos θ", np.pi)
ENERGY = Quantity(
    "U", "elastic potential energy", "mJ", 1e3, 1, 3, 10, "πEd³/3", "1/cos² θ", np.pi / 3
)


def over_tilt(name: str, quantity: Quantity) -> tuple[Sheet, ...]:
    """Over θ from −25° to 25° at each displacement."""
    theta = np.arange(-50, 51) / 2.0
    columns: list[tuple[str, str, FloatArray]] = [("theta", "deg", theta)]
    for d in DEPTHS:
        at = f"at d = {d} mm"
        closed = quantity.closed(np.float64(d), theta)
        columns.append((f"{quantity.symbol} {at}", quantity.unit, closed))
        integral = quantity.integral(np.float64(d), theta)
        columns.append(
            (f"{quantity.symbol} by eq. {quantity.equation} {at}", quantity.unit, integral)
        )
    return (sheet(name, *columns),)


def over_depth(name: str, quantity: Quantity) -> tuple[Sheet, ...]:
    """Over d up to 8 mm at each tilt, with the factor to the power at θ = 0; and the exponents.

    Factor and exponent come from the double integral, so that they owe the closed form nothing.
    """
    d = np.arange(81) / 10.0
    power = quantity.at_zero_tilt(d)
    columns: list[tuple[str, str, FloatArray]] = [("d", "mm", d)]
    rows = []
    for tilt in TILTS:
        theta = np.float64(tilt)
        closed, integral = quantity.closed(d, theta), quantity.integral(d, theta)
        factor = np.divide(integral, power, out=np.full_like(d, np.nan), where=d > 0)
        at = f"at {tilt} deg"
        columns.append((f"{quantity.symbol} {at}", quantity.unit, closed))
        columns.append(
            (f"{quantity.symbol} by eq. {quantity.equation} {at}", quantity.unit, integral)
        )
        columns.append((f"factor {at}", "1", factor))
        exponent = np.polyfit(np.log(d[1:]), np.log(integral[1:]), 1)[0]
        cosine = np.cos(np.radians(theta)) ** (1 - quantity.exponent)
        rows.append((tilt, exponent, factor[-1], cosine))
    exponents = np.array(rows, dtype=np.float64)
    return (
        sheet(name, *columns),
        sheet(
            f"{name}_exponents",
            ("theta", "deg", exponents[:, 0]),
            ("fitted exponent of d", "1", exponents[:, 1]),
            ("fitted factor", "1", exponents[:, 2]),
            (f"factor {quantity.prefactor}", "1", exponents[:, 3]),
        ),
    )


def draw_over_tilt(quantity: Quantity, figure: Figure, sheets: Sequence[Sheet]) -> None:
    """One panel: curves over θ, integrals as markers, the minimum marked."""
    (numbers,) = sheets
    axes = figure.subplots()
    theta = numbers["theta"]
    ends = []
    for d, style in zip(DEPTHS, ordered(len(DEPTHS)), strict=True):
        closed = numbers[f"{quantity.symbol} at d = {d} mm"]
        integral = numbers[f"{quantity.symbol} by eq. {quantity.equation} at d = {d} mm"]
        axes.plot(theta, closed, **style)
        axes.plot(
            theta[::10], integral[::10], "o", ms=4, mfc="none", mec=style["color"], clip_on=False
        )
        axes.plot(0.0, closed[theta == 0.0], "v", ms=6, color=style["color"])
        ends.append(float(closed[-1]))
    axes.set(xlabel="θ [deg]", ylabel=f"{quantity.label} {quantity.symbol} [{quantity.unit}]")
    axes.set_xlim(-25, 25)
    axes.set_ylim(0, 1.16 * max(ends))
    label_ends(axes, 25.0, ends, [f"d = {d} mm" for d in DEPTHS])
    _key(axes, quantity, minimum=True)
    _caption(figure, quantity, "a")


def draw_over_depth(quantity: Quantity, figure: Figure, sheets: Sequence[Sheet]) -> None:
    """Two panels: curves over d as in the paper, and their factor to the power, which is flat."""
    numbers, exponents = sheets
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    d = numbers["d"]
    ends, factors = [], []
    for tilt, style in zip(TILTS, ordered(len(TILTS)), strict=True):
        closed = numbers[f"{quantity.symbol} at {tilt} deg"]
        integral = numbers[f"{quantity.symbol} by eq. {quantity.equation} at {tilt} deg"]
        factor = numbers[f"factor at {tilt} deg"]
        left.plot(d, closed, **style)
        left.plot(
            d[10::10], integral[10::10], "o", ms=3.5, mfc="none", mec=style["color"], clip_on=False
        )
        right.plot(d[1:], factor[1:], **style)
        ends.append(float(closed[-1]))
        factors.append(float(factor[-1]))
    left.set(
        xlabel="displacement d [mm]",
        ylabel=f"{quantity.label} {quantity.symbol} [{quantity.unit}]",
        xlim=(0, 8),
    )
    left.set_ylim(0, 1.12 * max(ends))
    label_ends(left, 8.0, ends, [f"{tilt}°" for tilt in TILTS])
    left.annotate(
        f"continuous line:\n{quantity.symbol}(d, 0) = {quantity.power}",
        (6.0, float(numbers[f"{quantity.symbol} at 0 deg"][60])),
        (5.4, 0.1 * max(ends)),
        fontsize=7.5,
        color=INK,
        arrowprops={"arrowstyle": "->", "lw": 0.6, "color": GREY},
    )
    _key(left, quantity, minimum=False)
    right.set(
        xlabel="displacement d [mm]",
        ylabel=f"{quantity.symbol} by eq. {quantity.equation} over {quantity.power}",
        title=f"flat: the exponent is exactly {quantity.exponent}",
        xlim=(0, 8),
    )
    label_ends(
        right,
        8.0,
        factors,
        [f"{t}°: {f:.3f}" for t, f in zip(TILTS, factors, strict=True)],
    )
    fitted = exponents["fitted exponent of d"]
    right.text(
        0.03,
        0.94,
        f"exponents fitted to the integrals:\n{quantity.exponent} ± "
        f"{np.max(np.abs(fitted - quantity.exponent)):.0e}",
        transform=right.transAxes,
        va="top",
        fontsize=7.5,
    )
    _caption(figure, quantity, "b")


def _key(axes: Axes, quantity: Quantity, minimum: bool) -> None:
    axes.plot([], [], "-", color=INK, label="closed form")
    axes.plot(
        [], [], "o", ms=4, mfc="none", mec=INK, linestyle="none", label=f"eq. {quantity.equation}"
    )
    if minimum:
        axes.plot([], [], "v", ms=6, color=INK, linestyle="none", label="minimum")
    axes.legend(loc="upper center" if minimum else "upper left", ncols=3 if minimum else 1)


def _caption(figure: Figure, quantity: Quantity, part: str) -> None:
    page = PAGES[f"fig{4 if quantity is FORCE else 5}{part}"]
    lines = [f"Erratum, {each.place}: {each.holds}" for each in page.errata]
    caption(figure, [*lines, *page.notes])


_CLOSED = Erratum(
    "III-B",
    "it is difficult to calculate the double integrals, eqs. 3 and 10, analytically",
    "both integrals are elementary: F = πEd²/cos θ and U = πEd³/(3 cos² θ), for "
    "|θ| ≤ asin((a − d)/a).",
)
_TIP = "Tip of radius 20 mm, E = 0.304 MPa, as in the paper."

PAGES = {
    "fig4a": Page(
        title="Fig. 4a: total elastic force over the object's angle",
        size=(5.2, 4.2),
        sheets=partial(over_tilt, "fig4a", FORCE),
        draw=partial(draw_over_tilt, FORCE),
        errata=(_CLOSED,),
        notes=(_TIP,),
    ),
    "fig4b": Page(
        title="Fig. 4b: total elastic force over the displacement",
        size=(7.4, 4.1),
        sheets=partial(over_depth, "fig4b", FORCE),
        draw=partial(draw_over_depth, FORCE),
        errata=(
            Erratum(
                "III-B",
                "the continuous line is πEd², and all the other curves follow a power law whose "
                "exponent is more than the square",
                "the exponent is exactly 2 at every angle; the angle changes the prefactor alone, "
                "F = πEd² · 1/cos θ.",
            ),
        ),
        notes=(_TIP,),
    ),
    "fig5a": Page(
        title="Fig. 5a: elastic potential energy over the object's angle",
        size=(5.2, 4.4),
        sheets=partial(over_tilt, "fig5a", ENERGY),
        draw=partial(draw_over_tilt, ENERGY),
        errata=(
            _CLOSED,
            Erratum(
                "eqs. 10, 11",
                "the inner limits are ±f(x); eq. 11's outer limits run from B to A",
                "f(x) is b(x) of eq. 6, and eq. 11 runs from A to B: as printed its sign is wrong.",
            ),
        ),
        notes=(
            f"{_TIP} The minimum at θ = 0 holds at a fixed d; at a fixed normal force N it is "
            "U − N d that has it.",
        ),
    ),
    "fig5b": Page(
        title="Fig. 5b: elastic potential energy over the displacement",
        size=(7.4, 4.1),
        sheets=partial(over_depth, "fig5b", ENERGY),
        draw=partial(draw_over_depth, ENERGY),
        errata=(
            Erratum(
                "III-B",
                "the continuous line is proportional to the cube of d, and the power law exceeds "
                "the cube as the angle increases to 30°",
                "the exponent is exactly 3 at every angle; the angle changes the prefactor alone, "
                "U = (πEd³/3) · 1/cos² θ.",
            ),
        ),
        notes=(_TIP,),
    ),
}
