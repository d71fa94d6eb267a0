"""Run ``softfinger validate``: compare the model with published values.

Each row shows the computed value, the published value with its source, and a verdict. The verdict
is ``agree``, ``disagree`` or ``unknown``. If a quantity is not modelled or requires measurements on
hardware, the verdict is ``unknown`` with a reason.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.paper.model_pages import MODULUS, TIP, exponent
from softfinger.tools.terminal.text_layout import plain_table, table_text

POISSON = 0.49  # Poisson's ratio of the solid tips
DEPTHS = np.linspace(0.001, 0.007, 25)  # m
TILTS = np.radians(np.linspace(0.0, 20.0, 41))
FIGURES = {"agree": "✓", "disagree": "✗", "unknown": "?"}
_TRIALS = 5
_FRAMES = 64
_PRESSED = 0.005, 0.2  # displacement d [m] and tilt [rad] of the simulated contact


class PublishedValue(NamedTuple):
    """Row that compares a published value with the model's value."""

    quantity: str
    published: str
    source: str
    ours: str
    verdict: str  # key in FIGURES
    why: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "This takes a few seconds, because grips and frames are simulated."


def run(arguments: argparse.Namespace) -> int:
    """Print all comparisons as a table."""
    table = plain_table()
    for head in ("", "quantity", "published", "here", "source and remarks"):
        table.add_column(head, overflow="fold")
    found = list(comparisons())
    for each in found:
        why = f"{each.source}. {each.why}" if each.why else each.source
        table.add_row(FIGURES[each.verdict], each.quantity, each.published, each.ours, why)
    print(table_text(table, 150))
    print(", ".join(f"{sum(each.verdict == v for each in found)} {v}" for v in FIGURES))
    return 0


def comparisons() -> Iterator[PublishedValue]:
    """Yield all rows; each row is computed on demand."""
    for rows in (_tips, _energy, _relaxation, _sensors, _hands):
        yield from rows()


def between(quantity: str, low: float, high: float, source: str, ours: float, form: str = ".2f",
            unit: str = "", why: str = "") -> PublishedValue:  # fmt: skip
    """Compare ``ours`` with the range [low, high]; format ``form`` rounds all three values."""
    shown = [f"{each:{form}}" for each in (low, high, ours)]
    inside = float(shown[0]) <= float(shown[2]) <= float(shown[1])
    verdict = "agree" if inside else "disagree"
    text = f"{shown[0]} to {shown[1]}{unit}" if low < high else f"{shown[0]}{unit}"
    return PublishedValue(quantity, text, source, f"{shown[2]}{unit}", verdict, why)


_LAWS = {
    "springs": TIP,
    "solid, bonded": Fingertip(TIP.radius, "solid", POISSON, "bonded"),
    "solid, lying": Fingertip(TIP.radius, "solid", POISSON, "lying"),
    "solid, bonded, sticking": Fingertip(TIP.radius, "solid", POISSON, "bonded", "sticking"),
}


def _table(law: str) -> ContactTable:
    return ContactTable.build(_LAWS[law], Material.constant(MODULUS))


def _tips() -> Iterator[PublishedValue]:
    source = "Human Inspired Dexterity in Robotic Manipulation, table 7.1"
    for law in _LAWS:
        zeta = exponent(DEPTHS, _table(law)(DEPTHS, 0.0).force)
        stiff = "with a constant modulus, ζ = 2 for every E" if law == "springs" else ""
        yield between(f"ζ of F = C d^ζ, 1 to 7 mm: {law}", 1.46, 1.88, f"silicone cores: {source}",
                      zeta, why=stiff)  # fmt: skip
    radius = np.sqrt(2.0 * TIP.radius * DEPTHS - DEPTHS**2)
    yield between("γ of the contact radius, c N^γ: springs", 0.0, 1.0 / 3.0,
                  "Xydas & Kao, IJRR 18(9), 1999",
                  exponent(math.pi * MODULUS * DEPTHS**2, radius))  # fmt: skip
    yield PublishedValue("γ of the contact radius: solid", "0.00 to 0.33",
                         "Xydas & Kao, IJRR 18(9), 1999", "—", "unknown", "the data contain only "
                         "the pressure under the base, not on the face")  # fmt: skip
    springs = _table("springs")
    hertz = 4.0 / 3.0 * MODULUS / 0.75 * math.sqrt(TIP.radius)
    d = np.linspace(0.004, 0.0079, 3901)
    crossing = d[np.argmin(np.abs(springs(d, 0.0).force - hertz * d**1.5))]
    yield between("depth at which springs and Hertz (ν ½) have the same force", 6.4, 6.4,
                  "π E d² = 4/3 E* √a d^(3/2)", 1e3 * float(crossing), ".1f", " mm")  # fmt: skip


def _energy() -> Iterator[PublishedValue]:
    from softfinger.tools.paper import sheared_pages

    source = "Inoue & Hirai, the source of this model"
    for law in _LAWS:
        energy = _table(law)(0.004, TILTS).energy
        minimum = math.degrees(TILTS[int(np.argmin(energy))])
        falls = f"the energy decreases with the tilt until {minimum:.0f}° (tested: 0 to 20°)"
        why = f"at a fixed d, {falls}" if minimum > 0.0 else ""
        yield between(f"tilt of minimum U at d = 4 mm: {law}", 0.0, 0.0, source, minimum, ".1f",
                      "°", why)  # fmt: skip
    theta = np.radians(np.linspace(-11.5, 9.2, 208))
    rolled = sheared_pages.rolled(0.006, 0.05, theta)
    before = sheared_pages.angle_of_minimum(theta, rolled["F on the base"])
    verdict = "agree" if -3.0 < before < 0.0 else "disagree"
    yield PublishedValue("tilt of minimum force while rolling, d = 6 mm: springs",
                         "slightly before 0°", source, f"{before:.1f}°", verdict,
                         "if 5 % of the rolling motion shears the tip")  # fmt: skip
    d, chosen = 1e-3 * np.arange(8, 33) / 4.0, Material.constant(1.0)
    for face in ("frictionless", "sticking"):
        solid = ContactTable.build(replace(_LAWS["solid, bonded"], face=face), chosen)(d, 0.0).force
        springs = _table("springs")(d, 0.0).force
        modulus = float(np.polyfit(solid, springs, 1)[0])
        over = modulus * solid - springs
        yield PublishedValue(f"Fig. 7's offset from springs, 2 to 8 mm: solid, bonded, {face}",
                             "constant", source, f"{over.min():.1f} to {over.max():.1f} N",
                             "disagree", "with the best-fitting E, "
                             f"{1e-6 * modulus:.3f} MPa")  # fmt: skip


def _relaxation() -> Iterator[PublishedValue]:
    times = ", ".join(f"{t:g} s" for t in Settings().tip.relaxation_times)
    yield PublishedValue("relaxation of a fingerpad", "4 ms, 70 ms, 1.4 s", "Pawluk & Howe, 1999",
                         times, "unknown", "the defaults are the published values; `calibrate "
                         "relaxation` measures the amplitudes")  # fmt: skip
    yield PublishedValue("stability of a grasp over time", "increases",
                         "Tiezzi & Kao, T-RO 23(2), 2007", "—", "unknown",
                         "not investigated here")  # fmt: skip
    yield PublishedValue("softening in the first load cycles", "all tested elastomers",
                         "Case et al., Soft Robotics 2015", "none", "disagree",
                         "the simulated tips do not soften")  # fmt: skip
    yield PublishedValue("shear on a sticking face", "depends on the path",
                         "HydroShear, arXiv 2603.00446", "one path", "disagree",
                         "the data contain only straight presses along the normal")  # fmt: skip


def _sensors() -> Iterator[PublishedValue]:
    for name in ("ideal", "velostat", "capacitive"):
        d, angle, force = _errors(Settings() if name == "ideal" else load(Path(name)))
        for quantity, ours, published, unit, source in (
            ("depth", 1e3 * d, 0.4, " mm", "localisation error of Insight, arXiv 2111.05934"),
            ("angle", math.degrees(angle), 5.0, "°", "force direction, Insight, arXiv 2111.05934"),
            ("force", force, 0.44, " N", "uSkin 0.12, FingerTac 0.16 to 0.44, arXiv 2411.13335"),
        ):  # fmt: skip
            yield between(f"rms error of {quantity} at 5 mm: simulated sensor, {name}", 0.0,
                          published, source, ours, ".2f", unit)  # fmt: skip


def _errors(settings: Settings) -> tuple[float, float, float]:
    """Return the RMS errors of d [m], tilt [rad] and force [N] after the estimates have settled."""
    from softfinger.daemon.profile.factory import make_material
    from softfinger.tools.benchmarks.estimator import settled

    d, tilt = _PRESSED
    true = ContactTable.build(_LAWS["springs"], make_material(settings.material))
    found = settled(settings, (d, tilt, 0.0), _FRAMES)
    force = true(found[:, 0], np.hypot(found[:, 1], found[:, 2])).force - true(d, tilt).force
    off = np.stack((found[:, 0] - d, found[:, 1] - tilt, force))
    of_d, of_tilt, of_force = np.sqrt(np.mean(np.square(off), axis=1))
    return float(of_d), float(of_tilt), float(of_force)


def _hands() -> Iterator[PublishedValue]:
    from softfinger.tools.benchmarks.reflex import overloaded

    answers = [overloaded({}, 0.0, 13.0, seed).answer for seed in range(1, _TRIALS + 1)]
    simulated = "in virtual time, with only the simulated delays of bus and motor"
    yield between("maximum time from the onset of slip to a force increase", 0, 40,
                  "reaction in 35 to 40 ms, arXiv 2602.16127; humans 100 ms, Delhaye 2024",
                  1e3 * max(answers), ".0f", " ms", simulated)  # fmt: skip
    yield PublishedValue("all results on physical hardware", "—", "none yet", "—", "unknown",
                         "softfinger has not been tested on physical hardware")  # fmt: skip
