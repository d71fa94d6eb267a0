"""Generate documentation pages and tables from the code and from project files.

MkDocs calls the ``on_…`` functions (``hooks`` in mkdocs.yml). `PAGES` contains complete pages, and
`TABLES` contains tables within pages. All numbers that the code can compute are generated here.
``python docs/pages.py`` writes the tables into the pages in docs/, so that they can also be read
without building the site. ``python docs/pages.py picture`` draws docs/pictures/hand.svg, the moving
picture of the first page.
"""

from __future__ import annotations

import argparse
import html
import itertools
import json
import math
import os
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def _from(name: str) -> Callable[[], str]:
    """Return a function that reads a page from the project file ``name``."""
    return lambda: (ROOT / name).read_text(encoding="utf-8")


def _program(name: str) -> Callable[[], str]:
    """Return a function that makes a page from a program's source."""
    return lambda: f"# {Path(name).stem}\n\n```python\n{_from(name)()}```\n"


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _table(heads: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table, or an empty string if there are no rows."""
    body = "".join(map(_row, rows))
    return body and _row(heads) + "|---" * len(heads) + "|\n" + body


def _signed(value: float, form: str) -> str:
    """Format a number with a typographic minus sign; zero has no sign."""
    return f"{value:{form}}".replace("-", "−") if float(f"{value:{form}}") else f"{0.0:{form}}"


# --- settings -------------------------------------------------------------------------------------


def configuration() -> str:
    """List all profile sections and keys from their declarations."""
    from softfinger.daemon.profile import reference
    from softfinger.daemon.profile.load import names
    from softfinger.tools.setup.config import subject

    profiles = ((f"`{name}`", subject(Path(name))) for name in names())
    parts = [_table(("profile", "description"), profiles)]
    heads = ("key", "default", "unit", "allowed", "meaning")
    keys = reference.every_key()
    for name, section in reference.sections().items():
        rows = (
            (f"`{key.name}`", f"`{key.default}`", key.unit, key.allowed, key.meaning)
            for key in keys
            if key.section == name
        )
        parts.append(f"\n## `[{name}]`\n\n{reference.about(section)}\n\n{_table(heads, rows)}")
    return "".join(parts)


# --- the stream -----------------------------------------------------------------------------------


def stream() -> str:
    """List all topics and fields from the schema."""
    from softfinger.daemon.wire.schema_docs import page

    return page()


# --- commands and subcommands ---------------------------------------------------------------------


def commands() -> str:
    """Describe all hand commands from the command table."""
    from softfinger.daemon.control.modes import COMMANDS, REPLY, Mode
    from softfinger.daemon.loop.requests import bounds
    from softfinger.daemon.profile.settings import Settings
    from softfinger.daemon.types import NO_LEASE_COMMANDS

    rows = []
    for name, each in COMMANDS.items():
        given = ", ".join(
            f"`{key}`" + " (optional)" * (not parameter.required)
            for key, parameter in each.parameters.items()
        )
        where = "any" if each.modes == set(Mode) else ", ".join(m for m in Mode if m in each.modes)
        leased = "no" if name in NO_LEASE_COMMANDS | {"stop"} else "yes"
        rows.append((f"[`{name}`](#{name})", given, where, leased))
    heads = ("command", "parameters", "accepted in the modes", "needs the lease")
    parts = [_table(heads, rows)]
    for name, each in COMMANDS.items():
        rows = []
        for key, parameter in each.parameters.items():
            low, high = bounds(Settings(), key)
            numbers = f"{_signed(low, 'g')} to {_signed(high, 'g')}" if low > -math.inf else ""
            allowed = f"{parameter.range} ({numbers})" if parameter.range and numbers else ""
            allowed = allowed or parameter.range or numbers
            rows.append((f"`{key}`", parameter.unit, allowed, parameter.meaning))
        reply = ((f"`{field}`", REPLY[field]) for field in each.reply)
        refusals = ((f"`{reason}`", cause) for reason, cause in each.refusals.items())
        parts += [
            f"\n## {name}\n\n{each.action}\n\n",
            _table(("parameter", "unit", "range", "meaning"), rows) + "\n",
            _table(("reply field", "meaning"), reply) + "\n",
            _table(("reason of the rejection", "cause"), refusals),
        ]
    return "".join(parts)


def command_line() -> str:
    """Show the help text of each subcommand."""
    from softfinger.tools.cli import SUBCOMMANDS, make_parser

    os.environ["COLUMNS"] = "100"  # line width for argparse
    parser, _ = make_parser(SUBCOMMANDS)
    parts = [f"# The command line\n\n```text\n{parser.format_help()}```\n"]
    for name, subparser in _children(parser).items():
        parts.append(f"\n## {name}\n\n```text\n{subparser.format_help()}```\n")
        for action, inner in _children(subparser).items():
            parts.append(f"\n### {name} {action}\n\n```text\n{inner.format_help()}```\n")
    return "".join(parts)


def _children(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the subcommand parsers of ``parser`` by name."""
    found: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found |= action.choices
    return found


# --- limits ---------------------------------------------------------------------------------------


def limits() -> str:
    """List all limits with quantity, level, reaction time and settings."""
    from softfinger.daemon.profile.settings import Settings
    from softfinger.daemon.safety.limits import LIMITS
    from softfinger.tools.setup.limits import _values

    settings = Settings()
    taking_turns = sum(row.in_turn for row in LIMITS)
    rows = []
    for row in LIMITS:
        tick = 1e3 / settings.loop.rate
        lasts = getattr(settings.safety, row.lasts) if isinstance(row.lasts, str) else row.lasts
        after = f"{lasts:g} s + " if lasts else ""
        if row.in_turn:
            turns = 2 if lasts else 1  # One turn detects the violation, and one turn confirms it.
            when = f"{after}up to {turns * taking_turns * tick:g} ms"
        elif row.check:
            when = f"{after}one tick ({tick:g} ms)"
        else:
            when = "immediate"
        keys = ", ".join(_values(settings, row))
        rows.append((f"`{row.name}`", row.quantity, row.level, when, keys and f"`{keys}`"))
    heads = ("limit", "quantity", "level", "reaction time", "settings and defaults")
    return _table(heads, rows)


# --- events ---------------------------------------------------------------------------------------


def events() -> str:
    """List all event kinds from the table that explains them."""
    from softfinger.daemon.wire.event_kinds import KINDS

    rows = ((f"`{kind}`", each.levels, each.cause, each.remedy) for kind, each in KINDS.items())
    return _table(("kind", "level", "cause", "what to do"), rows)


# --- tables within pages --------------------------------------------------------------------------


def checkpoints() -> str:
    """Tabulate the closed forms for several displacements and tilts."""
    from softfinger.kinematics.contact.closed_form import closed_forms

    rows = []
    for d, theta in ((2, 0), (2, 30), (4, 0), (4, 15), (6, 30), (8, 0), (8, 30)):
        c = closed_forms(_MODULUS, 1e-3 * d, math.radians(theta))
        values = c.force, 1e3 * c.energy, c.energy_d, 1e3 * c.energy_theta
        rows.append([str(d), str(theta), *(f"{float(each):.12g}" for each in values)])
    return _table(("d [mm]", "θ [°]", "F [N]", "U [mJ]", "∂U/∂d [N]", "∂U/∂θ [mN·m]"), rows)


def rates() -> str:
    """Tabulate ∂F/∂θ and ∂U/∂θ at 25° from the paper's integrals."""
    from softfinger.tools.paper.model_pages import DEPTHS, ENERGY, FORCE

    heads = ("d [mm]", *(f"d = {d}" for d in DEPTHS))
    rows = [
        [f"∂{each.symbol}/∂θ at 25° [{each.unit}/rad]"]
        + [f"{float(each.steepness(float(d))):.3g}" for d in DEPTHS]
        for each in (FORCE, ENERGY)
    ]
    return _table(heads, rows)


def exponents() -> str:
    """Tabulate the exponent of d, fitted from 1 to 8 mm, for both material laws."""
    from softfinger.tools.paper.model_pages import ENERGY, FORCE, over_depth

    force, energy = (over_depth("", each)[1] for each in (FORCE, ENERGY))
    laws = ("fitted exponent of d", "fitted exponent of d, Table I's law")
    rows = [
        [f"{tilt:.0f}", *(f"{sheet[law][k]:.3f}" for sheet in (force, energy) for law in laws)]
        for k, tilt in enumerate(force["theta"])
    ]
    heads = ("θ [°]", "F, constant E", "F, Table I", "U, constant E", "U, Table I")
    return _table(heads, rows)


def early_minimum() -> str:
    """Tabulate the angles of minimum force and energy if part of the rolling shears the tip."""
    from softfinger.tools.paper.model_pages import DEPTHS
    from softfinger.tools.paper.sheared_pages import sheared_rolling

    *_, minima, plant = sheared_rolling()
    names = ("least F on the base", "least U")
    rows = []
    for d in DEPTHS:
        cells = [str(d)]
        for share in (2.0, 5.0, 10.0):
            at = (minima["d"] == d) & (minima["share"] == share)
            cells += [_signed(float(minima[name][at][0]), ".1f") for name in names]
        rows.append([*cells, _signed(float(plant["least U"][plant["d"] == d][0]), ".1f")])
    heads = [f"{symbol}, {share} %" for share in (2, 5, 10) for symbol in "FU"]
    return _table(("d [mm]", *heads, "U, 5 %, simulated tip"), rows)


_RADIUS, _MODULUS = 0.020, 0.304e6  # tip radius [m] and modulus [Pa] on the pages


def _contact_table(*law: Any) -> Any:
    """Build the contact table of a tip with the given contact law and a constant modulus."""
    from softfinger.kinematics.contact.closed_form import Fingertip
    from softfinger.kinematics.contact.material import Material
    from softfinger.kinematics.contact.table import ContactTable

    return ContactTable.build(Fingertip(_RADIUS, *law), Material.constant(_MODULUS))


def upright_forces() -> str:
    """Tabulate the force on upright tips for several contact laws."""

    def force(d: float, *law: Any) -> float:
        return float(_contact_table(*law)(d, 0.0).force)

    rows = []
    for d in (0.001, 0.002, 0.004, 0.006):
        solid = [
            f"{force(d, 'solid', 0.49, base):.3g} ({force(d, 'solid', 0.49, base, 'sticking'):.3g})"
            for base in ("bonded", "lying")
        ]
        hertz = 4.0 / 3.0 * _MODULUS / 0.75 * math.sqrt(_RADIUS) * d**1.5
        rows.append([f"{1e3 * d:g}", f"{force(d):.3g}", *solid, f"{hertz:.3g}"])
    solid_heads = (f"solid, {base}, ν 0.49 (sticking)" for base in ("bonded", "lying"))
    return _table(("d [mm]", "springs, F [N]", *solid_heads, "Hertz, ν ½"), rows)


def minimum_strength() -> str:
    """Tabulate c, the energy increase with tilt near upright, for each kind of tip."""
    theta, depths, rows = 0.01, (0.001, 0.002, 0.004, 0.006), []
    for name, law in (
        ("springs, before sliding", ()),
        ("solid rubber, lying on its sensor", ("solid", 0.49, "lying")),
        ("solid rubber, bonded", ("solid", 0.49, "bonded")),
    ):
        table = _contact_table(*law)
        found = ((d, table(d, theta)) for d in depths)
        strength = (float(c.energy_theta / (c.force * theta * d)) for d, c in found)
        rows.append([name, *(_signed(each, ".3f") for each in strength)])
    return _table(("tip", "d = 1 mm", "2 mm", "4 mm", "6 mm"), rows)


_FORCE, _WIDTH = 10.0, 0.040  # grip force [N] and object width [m] on the pages


def upright_grips() -> str:
    """Tabulate displacement, joint angle, upright spring and residual angle φ/φ0 of a grip."""
    from softfinger.daemon.profile.factory import make_table
    from softfinger.daemon.profile.settings import Settings
    from softfinger.kinematics.hand.upright import upright_spring

    rows = []
    constant = {"material": {"law": "constant", "modulus": _MODULUS}}
    for name, sections in (
        ("built-in hand, Table I", {}),
        ("constant E, 0.304 MPa", constant),
    ):
        settings = Settings.model_validate(sections)
        table = make_table(settings)
        hand, tip = settings.hand, settings.tip.radius
        low, high = 0.0, 0.01
        while high - low > 1e-9:
            d = 0.5 * (low + high)
            inward = 0.5 * hand.pivot_separation - tip + d - 0.5 * _WIDTH
            q = math.asin(inward / hand.finger_length)
            low, high = (d, high) if float(table(d, q).force) < _FORCE else (low, d)
        contact = table(d, 0.01)
        c = float(contact.energy_theta / (contact.force * 0.01 * d))
        lengths = 0.5 * hand.pivot_separation, hand.finger_length, hand.finger_offset, tip
        spring = upright_spring.py_func(q, d, _FORCE, c, lengths)
        angles = (_signed(_left_of(k, d, q, c), ".3f") for k in (0.0, spring, 1e9))
        rows.append([name, f"{1e3 * d:.2f}", f"{math.degrees(q):.1f}", f"{spring:.3f}", *angles])
    heads = ("d [mm]", "q [°]", "k [N·m/rad]", "φ/φ0: no spring", "spring k", "locked fingers")
    return _table(("10 N on 40 mm", *heads), rows)


def _left_of(spring: float, d: float, q: float, c: float) -> float:
    """Return φ/φ0 for the built-in hand from the closed form in `kinematics.hand.upright`.

    ``spring`` is in N·m/rad and ``d`` in m.
    """
    inward = 0.080 * math.sin(q)
    b = spring / (_FORCE * 0.050)
    line = _WIDTH * (2.0 * inward + (1.0 - 2.0 * c) * d - b * (_WIDTH - d))
    rolled = _RADIUS - d + inward + 0.5 * (1.0 + b) * d
    return line / (line - 4.0 * (_RADIUS - d + c * d) * rolled)


def symmetric_grips() -> str:
    """Tabulate joint angle, normal force and joint torque for symmetric grips without shear."""
    rows = []
    for d in (2, 4, 6, 8):
        q = math.asin((50.0 - 20.0 + d - 20.0) / 80.0)
        normal = math.pi * 0.304 * d**2 * (1.0 + 0.25 * math.tan(q) ** 2)
        cells = f"{math.degrees(q):.3f}", f"{normal:.3f}", f"{normal * 80.0 * math.cos(q):.1f}"
        rows.append([str(d), *cells])
    return _table(("d [mm]", "q [°]", "N [N]", "τ [mN·m]"), rows)


def torsion() -> str:
    """Tabulate the maximum friction moment about the normal of an upright spring tip.

    The moment is the integral of μ p r over the footprint, for a = 20 mm and E = 0.304 MPa.
    """
    rows, a = [], 20.0
    for d in (2, 4, 6, 8):
        h, rho = a - d, math.sqrt(2 * a * d - d * d)
        area = 0.5 * (a * a * math.asin(rho / a) - rho * h)
        moment = 2 * math.pi * 0.304 * (rho**3 / 3 - h * area)
        normal = math.pi * 0.304 * d * d
        share = moment / (normal * rho)
        rows.append([str(d), f"{normal:.2f}", f"{rho:.2f}", f"{moment:.1f}", f"{share:.3f}"])
    heads = ("d [mm]", "N [N]", "ρ [mm]", "M / μ [N·mm]", "M / (μ N ρ)")
    return _table(heads, rows)


def relaxations() -> str:
    """Tabulate the relative force after sudden compression for three relaxation models."""
    times = (0.001, 0.01, 0.1, 1.0, 10.0)
    prony = list(zip((0.1, 0.2, 0.2), (0.004, 0.07, 1.4), strict=True))
    laws: dict[str, Callable[[float], float]] = {
        "Kelvin-Voigt": lambda t: 1.0,
        "Maxwell, 1.4 s": lambda t: math.exp(-t / 1.4),
        "Prony, (0.1, 0.2, 0.2)": lambda t: (
            1.0 + sum(share * math.exp(-t / tau) for share, tau in prony)
        ),
    }
    rows = [[name, *(f"{law(t):.3f}" for t in times)] for name, law in laws.items()]
    return _table(("", *(f"{t:g} s" for t in times)), rows)


def errata() -> str:
    """List the errata that `softfinger figures` marks, without duplicates."""
    from softfinger.tools.paper.figures import pages

    found = dict.fromkeys(each for page in pages().values() for each in page.errata)
    return _table(
        ("place", "printed", "correct"), ((each.place, each.printed, each.holds) for each in found)
    )


def servos() -> str:
    """List the supported servo models with their tip forces and recommended limits."""
    from softfinger.daemon.servos.control_table import MODELS

    columns = ("V", "stall [N·m at A]", "N·m/A", "force [N]", "current_max [A]", "force_max [N]")
    rows = []
    for name, model in MODELS.items():
        torque, current, volts = model.stall
        low, high = (each / 10 for each in (model.voltage_min, model.voltage_max))
        supply = f"{volts:g} ({low:g} to {high:g})"
        force = f"{torque / 0.06:.3g}, {torque / 0.08:.3g}"
        cells = [supply, f"{torque:g} at {current:g}", "", force, "", ""]
        if model.senses_current:
            bound = 0.4 * torque
            cells[2] = f"{model.torque_constant:.3g}"
            cells[4:] = [f"{0.4 * current:.2g}", f"{bound / 0.06:.2g}, {bound / 0.08:.2g}"]
        rows.append([f"`{name}`", *cells])
    return _table(("`servos.model`", *columns), rows)


def _stored(name: str) -> tuple[str, list[dict[str, Any]]]:
    """Read `softfinger bench --json` output in docs/; return a machine description and the rows."""
    content = json.loads((ROOT / "docs" / name).read_text(encoding="utf-8"))
    load = " to ".join(f"{each:.1f}" for each in content["load"])
    about = f"{content['machine']}, {content['cores']} cores, load {load}.\n"
    return about, [row for row in content["rows"] if row["table"]]


def _shown(rows: Iterable[dict[str, Any]], keys: Sequence[str]) -> Iterable[list[str]]:
    for row in rows:
        cells = (row.get(key) for key in keys)
        told = ("" if c is None else c if isinstance(c, str) else f"{c:.3g}" for c in cells)
        yield [row["name"], *told]


def measured() -> str:
    """Tabulate the results of all default benchmarks (docs/benchmarks.json)."""
    from softfinger.tools.benchmarks.bench import PAGE_COLUMNS

    about, rows = _stored("benchmarks.json")
    parts = [about]
    shown = (row for row in rows if row.get("median") is not None)
    for title, each in itertools.groupby(shown, key=lambda row: row["table"]):
        heads = (title, "median", "p99", "unit", "aim ≤", "error", "RMS of d [µm]")
        parts.append("\n" + _table(heads, _shown(each, PAGE_COLUMNS)))
    return "".join(parts)


def _control(table: int) -> str:
    """Tabulate one table from the `softfinger bench control` results (docs/control.json)."""
    _, rows = _stored("control.json")
    titles = list(dict.fromkeys(row["table"] for row in rows))
    shown = (row for row in rows if row["table"] == titles[table])
    heads = ("", "median [°]", "p99 [°]", "draws held", "not held")
    return _table(heads, _shown(shown, ("median", "p99", "n", "not held")))


def _control_late(ending: str) -> str:
    """Tabulate the residual angle with delayed measurements; ``ending`` selects the tables."""
    _, rows = _stored("control.json")
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        if row["table"].endswith(ending):
            law, delay = row["name"].rsplit(", ", 1)
            held = "" if row.get("median") is None else f"{row['median']:.2g}°"
            lost = f"{row['not held']} of {row['not held'] + (row.get('n') or 0)} lost"
            cells = filter(None, (held, row["not held"] and lost))
            found.setdefault(delay, {})[law] = ", ".join(cells)
    laws = list(next(iter(found.values())))
    told = ([delay, *(by_law[law] for law in laws)] for delay, by_law in found.items())
    return _table(("delay", *laws), told)


def held_loads() -> str:
    """Tabulate how many sudden loads each simulated hand held (docs/reflex.json)."""
    _, rows = _stored("reflex.json")
    found: dict[str, dict[str, list[int]]] = {}
    for row in rows:
        if "push" in row["name"]:
            tips, mass = row["table"].removesuffix(", answer").rsplit(", ", 1)
            counts = found.setdefault(tips, {}).setdefault(mass, [0, 0, 0])
            trials = round(row["trials"])
            gripped = trials - round(row["no grip"])
            counts[0] += round(0.01 * (row["held %"] or 0.0) * gripped)
            counts[1] += trials
            counts[2] += trials - gripped
    masses = list(next(iter(found.values())))
    told = "{0} of {1}".format
    cells = ([tips, *(told(*by_mass[mass]) for mass in masses)] for tips, by_mass in found.items())
    return _table(("tips or sensor", *masses), cells)


def envelope_map() -> str:
    """Tabulate the mass up to which the built-in hand holds all tested objects."""
    from softfinger.daemon.control.envelope import HELD

    found = tomllib.loads((ROOT / "daemon/control/envelope.toml").read_text(encoding="utf-8"))
    masses, columns = found["mass"], {}
    for shape in found["shapes"]:
        for k, friction in enumerate(found["friction"]):
            outcomes = found[shape][k * len(masses) : (k + 1) * len(masses)]
            by_size = ("".join(each) for each in zip(*outcomes, strict=True))
            counts = [len(each) - len(each.lstrip(HELD)) for each in by_size]
            heaviest = [f"{masses[count - 1]:g}" if count else "–" for count in counts]
            columns[f"{_SHAPES[shape]}, {friction:g}"] = heaviest
    sizes = [f"{1e3 * each:g}" for each in found["size"]]
    return _table(("size [mm]", *columns), zip(sizes, *columns.values(), strict=True))


_SHAPES = {"rectangle": "block", "disc": "disc"}


def published() -> str:
    """Tabulate the rows from `softfinger validate`."""
    from softfinger.tools.paper.validate import FIGURES, comparisons

    heads = ("", "quantity", "published", "here", "source", "remarks")
    rows = (
        (FIGURES[each.verdict], each.quantity, each.published, each.ours, each.source, each.why)
        for each in comparisons()
    )
    return _table(heads, rows)


def save_grasp(path: Path) -> None:
    """Record a simulated grasp in virtual time, and save it as ``softfinger view --save`` does."""
    from softfinger.daemon.loop.warm_up import LANDSCAPE
    from softfinger.daemon.profile.settings import Settings
    from softfinger.testing import VirtualHand
    from softfinger.tools.processes.compile import build_kernels, print_event
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.viewing.document import save

    with TemporaryDirectory() as folder:
        recorded = Path(folder) / "grasp.mcap"
        with VirtualHand() as hand, hand.record(recorded):
            hand.run(0.3)
            hand.arm()
            hand.grasp(force=8.0)
            hand.run(1.7)
            for angle in (12.0, -12.0, 0.0):
                hand.rotate(math.radians(angle))
                hand.run(1.4)
            hand.release()
            hand.run(1.0)
        build_kernels(Settings(), print_event, LANDSCAPE)
        save(path, Recording(recorded), 0.1, print)


@cache  # `mkdocs serve` builds the site again after each change.
def grasp_page() -> str:
    """Return the page that plays the recorded grasp."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "grasp.html"
        save_grasp(path)
        return path.read_text(encoding="utf-8")


def recorded_grasp() -> str:
    """Embed the page that plays the recorded grasp."""
    return (
        "This is a simulated grasp, saved with `--save`. It plays in your browser:\n\n"
        '<iframe class="recorded" src="grasp.html" title="A recorded grasp" loading="lazy">'
        "</iframe>\n\n"
        '<a href="grasp.html">Open it in the whole window</a>\n'
    )


TABLES: dict[str, Callable[[], str]] = {
    "configuration": configuration,
    "commands": commands,
    "limits": limits,
    "events": events,
    "recorded_grasp": recorded_grasp,
    "published": published,
    "checkpoints": checkpoints,
    "rates": rates,
    "exponents": exponents,
    "early_minimum": early_minimum,
    "upright_forces": upright_forces,
    "minimum_strength": minimum_strength,
    "upright_grips": upright_grips,
    "symmetric_grips": symmetric_grips,
    "torsion": torsion,
    "relaxations": relaxations,
    "errata": errata,
    "servos": servos,
    "measured": measured,
    "control": partial(_control, 0),
    "control_limits": partial(_control, 1),
    "control_late": partial(_control_late, "delayed angle"),
    "control_late_tips": partial(_control_late, "two-phased"),
    "held_loads": held_loads,
    "envelope_map": envelope_map,
}

PAGES: dict[str, Callable[[], str]] = {
    "index.md": _from("README.md"),
    "contributing.md": _from("CONTRIBUTING.md"),
    "changelog.md": _from("CHANGELOG.md"),
    "example.md": _program("tools/examples/grasp_and_turn.py"),
    "stream.md": stream,
    "command-line.md": command_line,
}
# Links to these project files are replaced with links to documentation pages.
_LINKS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "daemon/wire/STREAM.md": "stream.md",
    "config/sim.toml": "configuration.md",
    "daemon/control/modes.py": "commands.md",
    "daemon/safety/limits.py": "limits.md",
    "daemon/wire/event_kinds.py": "events.md",
    "softfinger/__init__.py": "api.md",
    "tools/examples/grasp_and_turn.py": "example.md",
    "daemon/tactile/cobs.py": "contributing.md#a-tactile-board",
}


# A table in a page, from its mark to its end. Tables without an end are inserted only into the
# site, because they are too long for the page's source.
_TABLE = re.compile(
    r"(?P<mark><!-- table: (?P<name>\w+) -->)(?P<stored>\n(?:(?!<!--).)*<!-- end -->)?", re.S
)


def with_tables(markdown: str) -> str:
    """Return a page's source in which all stored tables are up to date."""

    def table(found: re.Match[str]) -> str:
        if not found["stored"]:
            return found[0]
        return f"{found['mark']}\n\n{TABLES[found['name']]()}\n<!-- end -->"

    return _TABLE.sub(table, markdown)


def on_config(config: Any) -> Any:
    """Show version and licence in the footer of each page."""
    from softfinger import __version__

    config.copyright = f"softfinger {__version__}, MIT licence"
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add all generated pages, the icon and the recorded grasp."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "grasp.html", content=grasp_page()))
    icon = (ROOT / "tools/viewing/web/icon.svg").read_text("utf-8")
    files.append(File.generated(config, "icon.svg", content=icon))
    for name, make in PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert generated tables, and replace links to repository files with links to pages."""
    markdown = _TABLE.sub(lambda found: f"\n\n{TABLES[found['name']]()}", markdown)

    def link(found: re.Match[str]) -> str:
        target = found[1].removeprefix("../").removeprefix("docs/")
        return f"]({_LINKS.get(target, target)}{found[2]})"

    return re.sub(r"\]\(((?!https?:)[^)#]+)(#[^)]*|)\)", link, markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Insert formulas and drawings inline, so that they use the colours of the page's theme.

    The arithmatex extension marks formulas. They are converted to MathML, which browsers render
    without scripts or fonts. Drawings use `currentColor`, which an image would not inherit.
    """
    content = re.sub(
        r'<(div|span) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', _formula, content, flags=re.S
    )
    return re.sub(r'<img [^>]*src="pictures/(\w+)\.svg"[^>]*>', _drawing, content)


def _formula(found: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    tex, display = html.unescape(found[2]).strip(), "block" if found[1] == "div" else "inline"
    # TeX adds space around function names, whereas MathML needs explicit spaces.
    function = r"\\(?:arcsin|cos|ln|sin|tan)(?:\^\d)?(?![a-z])"
    tex = re.sub(rf"(?<=[\w)}}])\s*(?={function})", r" \, ", tex)
    tex = re.sub(rf"({function})\s*(?=[\\\w])", r"\1 \, ", tex)
    return convert(tex, display=display)


def _drawing(found: re.Match[str]) -> str:
    """Return the drawing as inline SVG whose styles apply only to this drawing."""
    name = found[1]
    text = (ROOT / "docs" / "pictures" / f"{name}.svg").read_text(encoding="utf-8")

    def bound(rule: re.Match[str]) -> str:
        return ", ".join(f".{name} {each.strip()}" for each in rule[1].split(",")) + rule[2]

    def style(sheet: re.Match[str]) -> str:
        return re.sub(r"([^{}]+)(\{[^}]*\})", bound, sheet[0][7:-8]).join(("<style>", "</style>"))

    text = re.sub(r"<style>.*?</style>", style, text, flags=re.S)
    return text.replace("<svg ", f'<svg class="{name}" ', 1)


if __name__ == "__main__":
    if sys.argv[1:] == ["picture"]:
        save_grasp(ROOT / "docs" / "pictures" / "hand.svg")
    else:
        for page in ROOT.glob("docs/*.md"):
            page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
