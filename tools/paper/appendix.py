"""The paper's appendix: U(d, 0), eq. 12, in three terms, each by its integral and as printed.

`terms` and `limits` are SI and dimensionally the paper's: eq. 16 is a length, eq. 18 a number,
eq. 19 one over a length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss

from softfinger.tools.paper.model_pages import ENERGY, MILLI, MODULUS, TIP
from softfinger.tools.paper.sheets import (
    CIRCLE,
    DEPTH,
    Erratum,
    FigurePage,
    FloatArray,
    Panel,
    Sheet,
)
from softfinger.tools.style import INK, KINDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NODES = 64
_TERMS = ("first", "second", "third")


class Terms(NamedTuple):
    """The integrals of the root, of 1 and of the root's inverse over eq. 14's area element."""

    first: FloatArray  # eq. 16 [m]
    second: FloatArray  # eq. 18
    third: FloatArray  # eq. 19 [1/m]

    def energy(self, radius: float, modulus: float, d: FloatArray) -> FloatArray:
        """Return U(d, 0) by eq. 12 [J]."""
        first, second, third = self.terms(radius, modulus, d)
        return first + second + third

    def terms(self, radius: float, modulus: float, d: FloatArray) -> tuple[FloatArray, ...]:
        """Return each term's contribution to eq. 12's energy [J]."""
        h = radius - d
        factor = 0.5 * modulus * h**2
        return factor * self.first, -2.0 * h * factor * self.second, h**2 * factor * self.third


def limits(radius: float, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (θ_max, p) [rad], eqs. 15 and 17: θ at the contact's rim, and t there."""
    h = radius - d
    theta_max = np.arctan(np.sqrt(radius**2 - h**2) / h)
    return theta_max, np.arccos(h / radius * np.tan(theta_max))


def printed_terms(radius: float, d: FloatArray) -> Terms:
    """Return eqs. 16, 18 and 19 as they are printed, at d [m]."""
    h2 = (radius - d) ** 2
    return Terms(
        2.0 * np.pi * d / (3.0 * h2) * (3.0 * radius**2 - 3.0 * radius * d + d**2),
        np.pi * (radius**2 - h2) / h2,
        2.0 * np.pi * d / h2,
    )


def integrated_terms(radius: float, d: FloatArray) -> Terms:
    """Return them by Gauss quadrature of eq. 12 over θ; relative error ≤ 1e-12 to d = 0.7 a."""
    d = np.asarray(d, dtype=np.float64)[..., None]
    h = radius - d
    points, weights = leggauss(_NODES)
    theta_max, _ = limits(radius, d)
    theta = 0.5 * theta_max * (points + 1.0)
    area = np.pi * theta_max * weights * np.sin(theta) / np.cos(theta) ** 3  # and 2π for φ
    root = np.sqrt(radius**2 - (h * np.tan(theta)) ** 2)
    return Terms(*(np.sum(area * each, axis=-1) for each in (root, 1.0, 1.0 / root)))


def _appendix() -> tuple[Sheet, ...]:
    d = np.arange(1, 81) / 10.0  # the terms cancel to nothing at d = 0
    metres = d * MILLI
    columns = {"d [mm]": d}
    for how, terms in (
        ("as printed", printed_terms(TIP.radius, metres)),
        ("integrated", integrated_terms(TIP.radius, metres)),
    ):
        for name, term in zip(_TERMS, terms.terms(TIP.radius, MODULUS, metres), strict=True):
            columns[f"{name} term {how} [mJ]"] = 1e3 * term
        columns[f"U {how} [mJ]"] = 1e3 * terms.energy(TIP.radius, MODULUS, metres)
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
                "the last integral, of t⁻³ from cos θ_max to 1, has no dt",
                "it is 2π ∫ t⁻³ dt; its value is right.",
            ),
            Erratum(
                "Appendix I",
                "eq. 10 is converted to spherical coordinates",
                "x² + y² = (a − d)² tan² θ and eq. 14 are polar coordinates in the contact's "
                "plane, r = (a − d) tan θ: θ is the angle at the tip's centre to a point of that "
                "plane, not to one of the sphere.",
            ),
        ),
        notes=("Tip of radius 20 mm, E = 0.304 MPa, as in the paper.",),
    ),
}  # fmt: skip
