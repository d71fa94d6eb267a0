"""Draw model curves for the paper's two experiments and its appendix (Figs. 7, 10 and 11).

The paper shows its measurements only as plots, so the measured points are not reproduced. The
appendix splits U(d, 0) (eq. 12) into three terms. The terms are computed both by integration and
from the printed equations. The functions for the appendix use SI units. Eq. 16 is a length, eq. 18
is dimensionless, and eq. 19 is an inverse length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss

from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.paper.model_pages import (
    DEPTHS,
    ENERGY,
    FORCE,
    MILLI,
    MODULUS,
    TILTS,
    TIP,
    Numbers,
)
from softfinger.tools.paper.sheets import (
    CIRCLE,
    DEPTH,
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

PITCH = 0.058 / 44  # m
GRID = SensorGrid(rows=44, cols=44, pitch=PITCH)

TILTED = -11.5  # angle between finger and object after the finger rotation [degrees]
ROLLED = 9.2  # angle between finger and object after rolling by 20.7° [degrees]


def _force_table_i(d: Numbers, theta: Numbers) -> FloatArray:
    """Return F [N] for Table I's material law; d is in mm and θ in degrees."""
    return integrate(TIP, Material.table_i(), d * MILLI, np.radians(theta)).force


def compression() -> tuple[Sheet, ...]:
    """Tabulate the model's force and the sum of the cells' forces versus d and θ."""
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
            f"F at {tilt} deg [N]": FORCE.closed(d, theta),
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
    for tilt, style in ordered(TILTS):
        axes.plot(numbers["d"], numbers[f"F at {tilt} deg"], **style, label=f"{tilt}°")


def _compression_panels() -> Iterator[Panel]:
    """Yield panels (a) to (g) with one angle each, and panel (h) with all angles."""
    for k, (letter, tilt) in enumerate(zip("abcdefg", TILTS, strict=True)):
        labels = DEPTH if k >= 4 else "", "" if k % 4 else FORCE.axis
        place = "" if k else "upper left"
        yield Panel(partial(_one_tilt, tilt), *labels, f"({letter}) {tilt}°", legend=place)
    legend = {"loc": "upper left", "ncols": 2}
    yield Panel(_all_tilts, DEPTH, "", "(h) all", (0, 8.3), (0, 82), legend)


def tilt_and_roll() -> tuple[Sheet, ...]:
    """Return the force as the finger rotates about its root, and as the object then rolls.

    For each final displacement D, the root is D/sin 11.5° away from the tip centre. The tip first
    touches the object at θ = 0, so d = D sin |θ|/sin 11.5° during the rotation. During rolling, d
    is constant and equals D.
    """
    tilting = -np.arange(0, 116) / 10.0
    rolling = np.arange(-115, 93) / 10.0
    rise = np.sin(np.radians(tilting)) / np.sin(np.radians(TILTED))
    first, second = {"theta [deg]": tilting}, {"theta [deg]": rolling}
    for deepest in DEPTHS:
        d = np.float64(deepest)
        first |= {
            f"d up to {deepest} mm [mm]": d * rise,
            f"F, d up to {deepest} mm [N]": FORCE.closed(d * rise, tilting),
            f"F at d = {deepest} mm [N]": FORCE.closed(d, tilting),
        }
        force, law = FORCE.closed(d, rolling), _force_table_i(d, rolling)
        # If the springs point towards the tip centre (Nguyen and Arimoto), N = πE d² at any tilt.
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
    for d, style in ordered(DEPTHS):
        axes.plot(
            rotation["theta"], rotation[f"F, d up to {d} mm"], **style, label=f"d up to {d} mm"
        )
        axes.plot(rotation["theta"], rotation[f"F at d = {d} mm"], **thin)
    axes.plot([], [], color=INK, label="d rises from first touch")
    axes.plot([], [], **thin, label="d held at its last value")


def _rolling(axes: Axes, _: Sheet, rolling: Sheet) -> None:
    theta = rolling["theta"]
    axes.plot(theta, rolling["F/F(0) at d = 4 mm"], color=INK, label="constant E, every d: 1/cos θ")
    for d, style in ordered(DEPTHS):
        if d in (DEPTHS[0], DEPTHS[-1]):
            law = rolling[f"F/F(0) of Table I's law at d = {d} mm"]
            axes.plot(theta, law, **style | {"linewidth": 1.1}, label=f"Table I's law, d = {d} mm")
    radial = rolling["F of radial springs at d = 4 mm"]
    axes.plot(theta, radial / radial[theta == 0.0], ":", color=KINDS[1], label="radial springs")
    for x, marker in ((TILTED, "o"), (0.0, "v"), (ROLLED, "s")):
        ratio = float(rolling["F/F(0) at d = 4 mm"][np.argmin(np.abs(theta - x))])
        label = f"{x:g}°: {ratio:.4f}".replace("-", "−")
        axes.plot(x, ratio, marker, ms=5, color=INK, label=label)


_NODES = 64
_TERMS = ("first", "second", "third")


class Terms(NamedTuple):
    """Integrals of r, 1 and 1/r over the area element in eq. 14; r = √(a² − (a − d)² tan² θ)."""

    first: FloatArray  # eq. 16 [m]
    second: FloatArray  # eq. 18
    third: FloatArray  # 1/m, eq. 19

    def energies(self, radius: float, modulus: float, d: FloatArray) -> tuple[FloatArray, ...]:
        """Return each term's contribution [J] to U(d, 0) in eq. 12."""
        h = radius - d
        factor = 0.5 * modulus * h**2
        return factor * self.first, -2.0 * h * factor * self.second, h**2 * factor * self.third


def limits(radius: float, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return θ_max and p [rad], the values of θ and t at the contact rim (eqs. 15 and 17)."""
    h = radius - d
    theta_max = np.arctan(np.sqrt(radius**2 - h**2) / h)
    return theta_max, np.arccos(h / radius * np.tan(theta_max))


def printed_terms(radius: float, d: FloatArray) -> Terms:
    """Evaluate eqs. 16, 18 and 19 at ``d`` [m], as printed in the paper."""
    h2 = (radius - d) ** 2
    return Terms(
        2.0 * np.pi * d / (3.0 * h2) * (3.0 * radius**2 - 3.0 * radius * d + d**2),
        np.pi * (radius**2 - h2) / h2,
        2.0 * np.pi * d / h2,
    )


def integrated_terms(radius: float, d: FloatArray) -> Terms:
    """Compute the terms by Gauss quadrature (relative error ≤ 1e-12 up to d = 0.7 a)."""
    d = np.asarray(d, dtype=np.float64)[..., None]
    h = radius - d
    points, weights = leggauss(_NODES)
    theta_max, _ = limits(radius, d)
    theta = 0.5 * theta_max * (points + 1.0)
    # The integration over φ contributes a factor of 2π.
    area = np.pi * theta_max * weights * np.sin(theta) / np.cos(theta) ** 3
    root = np.sqrt(radius**2 - (h * np.tan(theta)) ** 2)
    return Terms(*(np.sum(area * each, axis=-1) for each in (root, 1.0, 1.0 / root)))


def _appendix() -> tuple[Sheet, ...]:
    d = np.arange(1, 81) / 10.0  # Exclude d = 0, where all terms are zero.
    metres = d * MILLI
    columns = {"d [mm]": d}
    for how, terms in (
        ("as printed", printed_terms(TIP.radius, metres)),
        ("integrated", integrated_terms(TIP.radius, metres)),
    ):
        parts = terms.energies(TIP.radius, MODULUS, metres)
        for name, part in zip(_TERMS, parts, strict=True):
            columns[f"{name} term {how} [mJ]"] = 1e3 * part
        columns[f"U {how} [mJ]"] = 1e3 * (parts[0] + parts[1] + parts[2])
    theta_max, p = limits(TIP.radius, metres)
    columns |= {"theta_max [deg]": np.degrees(theta_max), "p [deg]": np.degrees(p)}
    return (Sheet("fig11", columns),)


def _sums(axes: Axes, numbers: Sheet) -> None:
    d = numbers["d"]
    for name, color, dash in zip(_TERMS, KINDS, ("--", "-.", ":"), strict=False):
        printed = numbers[f"{name} term as printed"]
        axes.plot(d, printed, dash, color=color, label=f"{name} term")
        mark = CIRCLE | {"ms": 4, "mec": color}
        axes.plot(d[9::10], numbers[f"{name} term integrated"][9::10], **mark)
    axes.plot(d, ENERGY.at_zero_tilt(d), color=INK, label="sum: πEd³/3, eq. 20")
    mark = CIRCLE | {"ms": 4, "mec": INK}
    axes.plot(d[9::10], numbers["U integrated"][9::10], **mark, label="by quadrature of eq. 12")


PAGES = {
    "fig7": FigurePage(
        "Fig. 7: translational contact, force versus displacement at each angle",
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
                "The model's exponent is exactly 2 at every angle, with the prefactor 1/cos θ. "
                "The exponent is larger only if the modulus increases with the strain.",
            ),
            Erratum(
                "IV-A",
                "an approximately constant error over d, which a higher modulus brings close",
                "The force of springs is πE d²/cos θ. A different E multiplies F by a constant "
                "factor. It does not add a constant that is independent of d.",
            ),
        ),
        notes=(
            "Sensor: 44 × 44 cells on 58 mm × 58 mm; each cell averages the pressure over its "
            "area. The paper's measured points, which have a nearly constant offset, are not "
            "reproduced.",
        ),
    ),
    "fig10": FigurePage(
        "Fig. 10: rotational and rolling contact",
        (7.6, 4.3),
        tilt_and_roll,
        (
            Panel(_rotation, RELATIVE, FORCE.axis, "(a) the finger rotates", (0, TILTED), (0, 76),
                  "upper left"),
            Panel(_rolling, RELATIVE, "F(θ)/F(0) at equal d", "(b) then the object rolls by 20.7°",
                  (-24, 18), (0.9975, 1.038),
                  {"loc": "upper center", "ncols": 2, "columnspacing": 1.0}),
        ),
        layout={"width_ratios": (1.0, 1.25)},
        notes=(
            "The rotation of the finger produces negative angles. The paper gives neither d nor "
            "the distance of the finger's root. Therefore four depths are shown, and in (a) d "
            "increases from the first touch at 0° in proportion to sin |θ|. The measured forces, "
            "which differ by about 17 % in (b), are not reproduced. Their minimum slightly before "
            "0° is reproduced in fig10_shear.",
        ),
    ),
    "fig11": FigurePage(
        "Appendix: U(d, 0) = πEd³/3 from eq. 12's three terms",
        (5.2, 4.2),
        _appendix,
        (
            Panel(_sums, DEPTH, "part of U [mJ]", "eqs. 16, 18 and 19, each with its factor",
                  (0, 8.1), (-3200, 3600), {"loc": "upper left", "ncols": 2, "columnspacing": 1.0}),
        ),
        errata=(
            Erratum(
                "eq. 18",
                "the last integral, of t⁻³ from cos θ_max to 1, lacks dt",
                "The integral is 2π ∫ t⁻³ dt. Its value is correct.",
            ),
            Erratum(
                "Appendix I",
                "eq. 10 is converted to spherical coordinates",
                "x² + y² = (a − d)² tan² θ and eq. 14 are polar coordinates in the contact plane, "
                "r = (a − d) tan θ. The angle θ at the tip's centre specifies a point in this "
                "plane, not a point on the sphere.",
            ),
        ),
        notes=("Tip of radius 20 mm, E = 0.304 MPa, as in the paper.",),
    ),
}  # fmt: skip
