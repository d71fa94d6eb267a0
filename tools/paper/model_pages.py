"""Draw the material law (Fig. 3 and Table I) and the force and energy curves (Figs. 4 and 5).

In Figs. 4 and 5, lines show the closed forms. Markers show the paper's double integrals, evaluated
numerically.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

from softfinger.kinematics.contact.closed_form import Fingertip, closed_forms
from softfinger.kinematics.contact.material import (
    TABLE_I_MAXIMUM,
    TABLE_I_MODULUS,
    TABLE_I_STRAIN,
    Material,
)
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.tools.paper.sheets import (
    CIRCLE,
    DEPTH,
    Erratum,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
    summary,
)
from softfinger.tools.style import GREY, INK, KINDS, ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIP = Fingertip(radius=0.020)
MODULUS = TABLE_I_MAXIMUM  # modulus used in the paper [Pa]
MILLI = 1e-3
MPA = 1e-6
_NODES = 64  # number of Gauss nodes per double integral
_STEEP_TILT = 25  # tilt at which the figure states the slope [degrees]
_FITTED = slice(10, None)  # rows used to fit the exponents (d from 1 to 8 mm)
_STEP = 1e-4  # finite-difference step: relative for d, in rad for θ
DEPTHS = (2, 4, 6, 8)  # mm
TILTS = (0, 5, 10, 15, 20, 25, 30)  # degrees

Numbers = FloatArray | np.float64


# Fig. 3 and Table I


def _tangent(material: Material, strain: FloatArray) -> FloatArray:
    """Return the tangent modulus dσ/dε [Pa]."""
    slope = [j * float(value) for j, value in enumerate(material.coefficients, 1)]
    return np.asarray(np.polynomial.polynomial.polyval(strain, slope), dtype=np.float64)


def law() -> tuple[Sheet, ...]:
    """Tabulate the material law versus strain, and compare it with the points in Table I."""
    material = Material.table_i()
    strain, nodes = np.arange(101) / 100.0, np.array(TABLE_I_STRAIN)
    curve = {
        "strain [%]": np.arange(101.0),
        "stress [MPa]": material.stress(strain) * MPA,
        "modulus [MPa]": _tangent(material, strain) * MPA,
        "stress at constant 0.304 MPa [MPa]": TABLE_I_MAXIMUM * strain * MPA,
    }
    table = {
        "entry": ["Min", *(f"{100.0 * each:g} %" for each in nodes[1:]), "Max"],
        "strain [%]": [*(100.0 * nodes), np.nan],
        "modulus in the paper [MPa]": np.array([*TABLE_I_MODULUS, TABLE_I_MAXIMUM]) * MPA,
        "modulus of the law [MPa]": [*(_tangent(material, nodes) * MPA), np.nan],
    }
    return Sheet("fig3", curve), Sheet("table_i", table)


def _stress(axes: Axes, curve: Sheet, _: Sheet) -> None:
    strain, constant = curve["strain"], curve["stress at constant 0.304 MPa"]
    axes.plot(strain, curve["stress"], color=KINDS[0], label="law through Table I")
    axes.plot(strain, constant, "--", color=KINDS[1], label="constant modulus, 0.304 MPa")


def _slope(axes: Axes, curve: Sheet, table: Sheet) -> None:
    """Draw the material law's slope, and Table I's points labelled with their values."""
    axes.plot(curve["strain"], curve["modulus"], color=KINDS[0], label="slope of the law")
    measured = table["modulus in the paper"]
    axes.plot(table["strain"], measured, "o", color="white", mec=KINDS[0], mew=1.4, label="Table I")
    axes.axhline(measured[-1], color=KINDS[1], linestyle="--", linewidth=1.2)
    axes.text(1, measured[-1] - 0.004, "Max, beyond 100 %: the paper's E", va="top", fontsize=7.5)
    for x, y in zip(table["strain"][:-1], measured, strict=False):
        place = (-4, 4) if x else (2, -12)
        axes.annotate(f"{y:.3f}", (x, y), place, textcoords="offset points", color=GREY,
                      ha="right" if x else "left", fontsize=7.5)  # fmt: skip


# Figs. 4 and 5


def double_integrals(
    radius: float, modulus: float, d: ArrayLike, theta: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Integrate eqs. 3 and 10 as printed, and return F [N] and U [J].

    ``d`` [m] and ``theta`` [rad] are broadcast against each other. The product Gauss quadrature is
    independent of the closed forms. The relative error is ≤ 1e-10 if θ is at least 6° below its
    limit. F and U are 0 at d = 0.
    """
    points, weights = leggauss(_NODES)
    # Substituting sines for x and y keeps the quadrature accurate at the rim of the ellipse.
    angle = 0.5 * np.pi * points
    weight = 0.5 * np.pi * weights * np.cos(angle)
    depth, tilt = np.broadcast_arrays(np.asarray(d, float), np.asarray(theta, float))
    force = np.empty(depth.shape)
    energy = np.empty(depth.shape)
    for i in np.ndindex(depth.shape):
        s, c, h = np.sin(tilt[i]), np.cos(tilt[i]), radius - depth[i]
        rho = np.sqrt(depth[i] * (radius + h))
        x = (h * s + rho * c * np.sin(angle))[:, None]
        b = np.sqrt(np.maximum(rho**2 - ((x - h * s) / c) ** 2, 0.0))  # eq. 6
        y = b * np.sin(angle)
        area = (rho * c * weight)[:, None] * b * weight
        z = np.sqrt(radius**2 - x**2 - y**2)
        q = (h - x * s) / c  # height of the object face above the base
        force[i] = modulus * np.sum((1.0 - q / z) * area)
        energy[i] = 0.5 * modulus * np.sum((z - 2.0 * q + q**2 / z) * area)  # eq. 9
    return force, energy


@dataclass(frozen=True)
class Plotted:
    """Plotted quantity (force or energy), with its symbol and unit."""

    symbol: str
    label: str
    unit: str
    scale: float  # factor from SI to this unit
    row: int  # index of the quantity in the results of closed_forms and double_integrals
    slope: int  # index of the derivative with respect to d in closed_forms
    exponent: int
    equation: int
    power: str  # power law in d at θ = 0
    prefactor: str
    straight: float  # prefactor of the power law, divided by E

    def closed(self, d: Numbers, theta: Numbers) -> FloatArray:
        """Return the closed form in the figure's unit; d is in mm and θ in degrees."""
        return closed_forms(MODULUS, d * MILLI, np.radians(theta))[self.row] * self.scale

    def integral(self, d: Numbers, theta: Numbers) -> FloatArray:
        """Return the double integral in the figure's unit; d is in mm and θ in degrees."""
        pair = double_integrals(TIP.radius, MODULUS, d * MILLI, np.radians(theta))
        return pair[self.row] * self.scale

    def local_exponent(self, d: Numbers, theta: Numbers) -> FloatArray:
        """Return d ln(integral) / d ln(d); d is in mm and θ in degrees."""
        above, below = (self.integral(d * (1.0 + step), theta) for step in (_STEP, -_STEP))
        return np.log(above / below) / math.log((1.0 + _STEP) / (1.0 - _STEP))

    def steepness(self, d: Numbers) -> FloatArray:
        """Return the integral's derivative with respect to θ at 25° [unit/rad]; d is in mm."""
        step = math.degrees(_STEP)
        above, below = (self.integral(d, np.float64(_STEEP_TILT + each)) for each in (step, -step))
        return (above - below) / (2.0 * _STEP)

    def at_zero_tilt(self, d: Numbers) -> FloatArray:
        """Return the paper's solid line (πEd² or πEd³/3) in the figure's unit; d is in mm."""
        return self.straight * MODULUS * np.asarray(d * MILLI) ** self.exponent * self.scale

    def largest(self, tilt: float) -> float:
        """Return the quantity at d = 8 mm and at ``tilt`` [degrees], in the figure's unit."""
        cosine = np.cos(np.radians(tilt)) ** (self.exponent - 1)
        return float(self.at_zero_tilt(np.float64(8.0)) / cosine)

    @property
    def axis(self) -> str:
        return f"{self.label} {self.symbol} [{self.unit}]"

    def columns(self, d: Numbers, theta: Numbers, at: str) -> dict[str, FloatArray]:
        """Return the columns for the closed form and the double integral."""
        return {
            f"{self.symbol} {at} [{self.unit}]": self.closed(d, theta),
            f"{self.symbol} by eq. {self.equation} {at} [{self.unit}]": self.integral(d, theta),
        }


FORCE = Plotted("F", "total elastic force", "N", 1.0, 0, 2, 2, 3, "πEd²", "1/cos θ", np.pi)
ENERGY = Plotted(
    "U", "elastic potential energy", "mJ", 1e3, 1, 4, 3, 10, "πEd³/3", "1/cos² θ", np.pi / 3
)


def over_tilt(name: str, quantity: Plotted) -> tuple[Sheet, ...]:
    """Tabulate the quantity versus θ from −25° to 25° at each displacement."""
    theta = np.arange(-50, 51) / 2.0
    columns = {"theta [deg]": theta}
    for d in DEPTHS:
        columns |= quantity.columns(np.float64(d), theta, f"at d = {d} mm")
    depths = np.array(DEPTHS, dtype=np.float64)
    head = f"d{quantity.symbol}/dtheta at {_STEEP_TILT} deg [{quantity.unit}/rad]"
    rate = {"d [mm]": depths, head: quantity.steepness(depths)}
    return Sheet(name, columns), Sheet(f"{name}_rate", rate)


def over_depth(name: str, quantity: Plotted) -> tuple[Sheet, ...]:
    """Tabulate the quantity and its exponents at each tilt, for d up to 8 mm.

    For each tilt, a second sheet contains the fitted exponent and the ratio of the quantity to its
    value at θ = 0. The second sheet is computed from the double integral, not from the closed form.
    The exponents for Table I's law are computed from the integral of that law.
    """
    d = np.arange(81) / 10.0
    power = quantity.at_zero_tilt(d)
    columns = {"d [mm]": d}
    rows = []
    for tilt in TILTS:
        theta, at = np.float64(tilt), f"at {tilt} deg"
        columns |= quantity.columns(d, theta, at)
        integral = quantity.integral(d, theta)
        law = integrate(TIP, Material.table_i(), d * MILLI, np.radians(theta))
        value, slope = np.asarray(law[quantity.row]), np.asarray(law[quantity.slope])
        local = np.full((2, d.size), np.nan)
        local[0, 1:] = quantity.local_exponent(d[1:], theta)
        local[1, 1:] = slope[1:] * d[1:] * MILLI / value[1:]
        columns |= {
            f"{quantity.symbol} of Table I's law {at} [{quantity.unit}]": value * quantity.scale,
            f"exponent {at} [1]": local[0],
            f"exponent of Table I's law {at} [1]": local[1],
        }
        row = {
            "theta [deg]": tilt,
            "fitted exponent of d [1]": exponent(d[_FITTED], integral[_FITTED]),
            "fitted exponent of d, Table I's law [1]": exponent(d[_FITTED], value[_FITTED]),
            "fitted factor [1]": integral[-1] / power[-1],
            f"factor {quantity.prefactor} [1]": math.cos(math.radians(tilt))
            ** (1 - quantity.exponent),
        }
        rows.append(row)
    return Sheet(name, columns), summary(f"{name}_exponents", rows)


def exponent(d: FloatArray, values: FloatArray) -> float:
    """Return ζ from a least-squares fit of ln ``values`` = ln C + ζ ln ``d``."""
    return float(np.polyfit(np.log(d), np.log(values), 1)[0])


def _key(axes: Axes, quantity: Plotted) -> None:
    axes.plot([], [], color=INK, label="closed form")
    axes.plot([], [], **CIRCLE | {"ms": 4, "mec": INK}, label=f"eq. {quantity.equation}")


def _tilt_curves(quantity: Plotted, axes: Axes, numbers: Sheet, rates: Sheet) -> None:
    theta = numbers["theta"]
    rate = rates[f"d{quantity.symbol}/dtheta at {_STEEP_TILT} deg"]
    for (d, style), at in zip(ordered(DEPTHS), rate, strict=True):
        closed = numbers[f"{quantity.symbol} at d = {d} mm"]
        integral = numbers[f"{quantity.symbol} by eq. {quantity.equation} at d = {d} mm"]
        label = f"d = {d} mm: {at:.1f} {quantity.unit}/rad at {_STEEP_TILT}°"
        axes.plot(theta, closed, **style, label=label)
        look = CIRCLE | {"ms": 4, "mec": style["color"], "clip_on": False}
        axes.plot(theta[::10], integral[::10], **look)
        axes.plot(0.0, closed[theta == 0.0], "v", ms=6, color=style["color"])
    _key(axes, quantity)
    axes.plot([], [], "v", ms=6, color=INK, label="minimum")


def _depth_curves(quantity: Plotted, axes: Axes, numbers: Sheet, _: Sheet) -> None:
    d = numbers["d"]
    for tilt, style in ordered(TILTS):
        integral = numbers[f"{quantity.symbol} by eq. {quantity.equation} at {tilt} deg"]
        axes.plot(d, numbers[f"{quantity.symbol} at {tilt} deg"], **style, label=f"{tilt}°")
        look = CIRCLE | {"ms": 3.5, "mec": style["color"], "clip_on": False}
        axes.plot(d[10::10], integral[10::10], **look)
    _key(axes, quantity)


def _exponents(quantity: Plotted, axes: Axes, numbers: Sheet, fitted: Sheet) -> None:
    d = numbers["d"]
    axes.axhline(
        quantity.exponent, color=INK, label=f"constant E, every angle: {quantity.exponent}"
    )
    axes.plot(d[10::10], numbers["exponent at 30 deg"][10::10], **CIRCLE | {"ms": 4, "mec": INK})
    power = fitted["fitted exponent of d, Table I's law"]
    for (tilt, style), fit in zip(ordered(TILTS), power, strict=True):
        if tilt % 10 == 0:
            local = numbers[f"exponent of Table I's law at {tilt} deg"]
            axes.plot(d, local, **style, label=f"Table I, {tilt}°: {fit:.3f} from 1 to 8 mm")


def _tilt_page(name: str, title: str, height: float, quantity: Plotted, **more: Any) -> FigurePage:
    legend = {"loc": "upper center", "ncols": 2, "columnspacing": 1.0}
    panel = Panel(partial(_tilt_curves, quantity), "θ [deg]", quantity.axis, "", (-25, 25),
                  (0, 1.25 * quantity.largest(25.0)), legend)  # fmt: skip
    return FigurePage(title, (5.2, height), partial(over_tilt, name, quantity), (panel,), **more)


def _depth_page(name: str, title: str, quantity: Plotted, **more: Any) -> FigurePage:
    line = f"continuous line: {quantity.symbol}(d, 0) = {quantity.power}"
    left = Panel(partial(_depth_curves, quantity), DEPTH, quantity.axis, line, (0, 8),
                 (0, 1.12 * quantity.largest(30.0)), "upper left")  # fmt: skip
    n = quantity.exponent
    right = Panel(
        partial(_exponents, quantity),
        DEPTH,
        f"d ln {quantity.symbol} / d ln d",
        "exponent of the displacement",
        (0, 8),
        (n - 0.02, n + 0.4),
        "upper left",
    )
    sheets = partial(over_depth, name, quantity)
    layout = {"width_ratios": (1.15, 1.0)}
    return FigurePage(title, (7.4, 4.1), sheets, (left, right), layout=layout, **more)


_CLOSED = Erratum(
    "III-B",
    "it is difficult to calculate the double integrals, eqs. 3 and 10, analytically",
    "Both integrals are elementary: F = πEd²/cos θ and U = πEd³/(3 cos² θ) for "
    "|θ| ≤ asin((a − d)/a).",
)
_TIP = "Tip of radius 20 mm, E = 0.304 MPa, as in the paper."

PAGES = {
    "fig3": FigurePage(
        "Fig. 3 and Table I: stress-strain law of the tip's material",
        (7.0, 3.6),
        law,
        (
            Panel(_stress, "strain [%]", "stress [MPa]", "(b) stress-strain diagram",
                  legend="upper left"),
            Panel(_slope, "strain [%]", "modulus, slope of the curve [MPa]", "Table I", None,
                  (0.0, 0.33), "lower right"),
        ),
        errata=(
            Erratum(
                "III-A",
                "Young's modulus is comparatively large when the fingertip deforms a little, and "
                "comparatively small unless it deforms largely",
                "The text contradicts Table I, in which the modulus increases with the strain, "
                "from 0.135 to 0.304 MPa. Calibrate E in compression; the default is 0.304 MPa.",
            ),
            Erratum(
                "III-A",
                "the springs follow the true stress versus strain of a tension test",
                "The springs are compressed. For a neo-Hookean rubber with the modulus E at small "
                "strains, the true stress at 40 % strain is 0.42 E in tension and 0.44 E in "
                "compression. The force per initial cross-section is 0.30 E in tension and 0.73 E "
                "in compression.",
            ),
        ),
        notes=(
            "The paper prints only the numbers of Table I. The plotted specimens are not "
            "reproduced.",
        ),
    ),
    "fig4a": _tilt_page(
        "fig4a",
        "Fig. 4a: total elastic force versus object angle",
        4.2,
        FORCE,
        errata=(_CLOSED,),
        notes=(_TIP,),
    ),
    "fig4b": _depth_page(
        "fig4b",
        "Fig. 4b: total elastic force versus displacement",
        FORCE,
        errata=(
            Erratum(
                "III-B",
                "the continuous line is πEd², and all the other curves follow a power law whose "
                "exponent is more than the square",
                "With the constant E of the plot, the exponent is exactly 2 at every angle. The "
                "angle changes only the prefactor, F = πEd² · 1/cos θ. With the law of Table I, "
                "the exponent is above 2 and increases with the angle.",
            ),
        ),
        notes=(_TIP,),
    ),
    "fig5a": _tilt_page(
        "fig5a",
        "Fig. 5a: elastic potential energy versus object angle",
        4.4,
        ENERGY,
        errata=(
            _CLOSED,
            Erratum(
                "eqs. 10, 11",
                "the inner limits are ±f(x); eq. 11's outer limits run from B to A",
                "f(x) is b(x) of eq. 6. Eq. 11 runs from A to B; its printed sign is wrong.",
            ),
        ),
        notes=(
            f"{_TIP} At a fixed d, U is minimal at θ = 0. At a fixed normal force N, U − N d is "
            "minimal at θ = 0.",
        ),
    ),
    "fig5b": _depth_page(
        "fig5b",
        "Fig. 5b: elastic potential energy versus displacement",
        ENERGY,
        errata=(
            Erratum(
                "III-B",
                "the continuous line is proportional to the cube of d, and the power law exceeds "
                "the cube as the angle increases to 30°",
                "With the constant E of the plot, the exponent is exactly 3 at every angle. The "
                "angle changes only the prefactor, U = (πEd³/3) · 1/cos² θ. With the law of Table "
                "I, the exponent is above 3 and increases with the angle.",
            ),
        ),
        notes=(_TIP,),
    ),
}  # fmt: skip
