"""Fig. 3 and Table I: the measured slopes of the stress-strain curve, and the law through them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from softfinger.kinematics.contact.material import (
    TABLE_I_MAXIMUM,
    TABLE_I_MODULUS,
    TABLE_I_STRAIN,
    Material,
)
from softfinger.tools.paper.sheets import Erratum, FloatArray, Page, Sheet, sheet
from softfinger.tools.paper.style import GREY, KINDS, caption

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MPA = 1e-6
PERCENT = 100.0


def _modulus(material: Material, strain: FloatArray) -> FloatArray:
    """Tangent modulus dσ/dε [Pa]."""
    slope = [j * float(value) for j, value in enumerate(material.coefficients, 1)]
    return np.asarray(np.polynomial.polynomial.polyval(strain, slope), dtype=np.float64)


def sheets() -> tuple[Sheet, ...]:
    """The law over strain, and Table I with the law at its strains."""
    law = Material.table_i()
    strain = np.arange(101) / 100.0
    curve = sheet(
        "fig3",
        ("strain", "%", np.arange(101.0)),
        ("stress", "MPa", law.stress(strain) * MPA),
        ("modulus", "MPa", _modulus(law, strain) * MPA),
        ("stress at constant 0.304 MPa", "MPa", TABLE_I_MAXIMUM * strain * MPA),
    )
    nodes = np.array(TABLE_I_STRAIN)
    table = sheet(
        "table_i",
        ("entry", "", ["Min", *(f"{each * PERCENT:g} %" for each in nodes[1:]), "Max"]),
        ("strain", "%", [*(nodes * PERCENT), np.nan]),
        ("modulus in the paper", "MPa", np.array([*TABLE_I_MODULUS, TABLE_I_MAXIMUM]) * MPA),
        ("modulus of the law", "MPa", [*(_modulus(law, nodes) * MPA), np.nan]),
    )
    return curve, table


def draw(figure: Figure, sheets: Sequence[Sheet]) -> None:
    """Stress over strain, and its slope over strain with Table I's entries."""
    curve, table = sheets
    left, right = figure.subplots(1, 2)
    strain = curve["strain"]
    left.plot(strain, curve["stress"], color=KINDS[0], label="law through Table I")
    left.plot(
        strain,
        curve["stress at constant 0.304 MPa"],
        color=KINDS[1],
        linestyle="--",
        label="constant modulus, 0.304 MPa",
    )
    left.set(xlabel="strain [%]", ylabel="stress [MPa]", title="(b) stress-strain diagram")
    left.legend(loc="upper left")

    measured = table["modulus in the paper"]
    right.plot(strain, curve["modulus"], color=KINDS[0], label="slope of the law")
    right.plot(
        table["strain"], measured, "o", color="white", mec=KINDS[0], mew=1.4, label="Table I"
    )
    right.axhline(measured[-1], color=KINDS[1], linestyle="--", linewidth=1.2)
    right.text(1, measured[-1] - 0.004, "Max, beyond 100 %: the paper's E", va="top", fontsize=7.5)
    for name, x, y in zip(table["entry"], table["strain"], measured, strict=True):
        if np.isfinite(x):
            right.annotate(
                f"{y:.3f}" + (" (Min)" if name == "Min" else ""),
                (x, y),
                (-2, -16) if name == "Min" else (-7, 2) if x == PERCENT else (4, -11),
                textcoords="offset points",
                ha="right" if x == PERCENT else "left",
                fontsize=7.5,
                color=GREY,
            )
    right.set(
        xlabel="strain [%]",
        ylabel="modulus, slope of the curve [MPa]",
        title="Table I",
        ylim=(0.0, 0.33),
    )
    right.legend(loc="lower right")
    caption(figure, [f"Erratum, {e.place}: {e.holds}" for e in PAGE.errata] + list(PAGE.notes))


PAGE = Page(
    title="Fig. 3 and Table I: stress-strain law of the tip's material",
    size=(7.0, 3.6),
    sheets=sheets,
    draw=draw,
    errata=(
        Erratum(
            "III-A",
            "Young's modulus is comparatively large when the fingertip deforms a little, and "
            "comparatively small unless it deforms largely",
            "Table I's modulus rises with strain, from 0.135 to 0.304 MPa, so the text has it both "
            "ways; E is a number to calibrate in compression, 0.304 MPa by default.",
        ),
    ),
    notes=("The paper prints Table I's numbers alone; its plotted specimens are not reproduced.",),
)
