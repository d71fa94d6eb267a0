"""The pages of the site that are made at its build: from the code, and from the project's folder.

MkDocs calls the functions named ``on_…`` (``hooks`` in mkdocs.yml). `PAGES` is all there is.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def _from(name: str) -> Callable[[], str]:
    """The page is a file of the project's folder."""
    return lambda: (ROOT / name).read_text(encoding="utf-8")


def _program(name: str) -> Callable[[], str]:
    """The page shows a program of the project's folder."""
    return lambda: f"# {Path(name).stem}\n\n```python\n{_from(name)()}```\n"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _head(*cells: str) -> str:
    return _row(*cells) + "|---" * len(cells) + "|\n"


# --- settings -------------------------------------------------------------------------------------


_SETTINGS = """\
# Settings

A profile is a TOML file with the settings that differ from the defaults below, which are those of
the built-in simulated hand. To change a setting for one run, write `--set loop.rate=1000`. Units
are SI unless stated otherwise, and pairs are [left, right]. A hand may have one finger or two, and
may lack servos or sensors.

Unknown keys, wrong types and numbers out of range are reported together at the start. Errors that
only show while the models are built follow: a contact table that cannot reach `table.tolerance`, a
law that misses its measured points, a calibration file that does not fit.

`softfinger config reference SECTION` prints a section in the terminal.

Editors complete and check keys with the JSON schema that the first line of the packaged profiles
names (Even Better TOML in VS Code, Taplo in others). Begin a profile of your own with both:

```sh
softfinger config show hil > my.toml
softfinger config schema > schema.json
```

## Profiles

`--config hil` finds one of these by its name, wherever softfinger is installed; a path names a
profile of your own.

"""


def configuration() -> str:
    """Every section and key, from their declarations."""
    from softfinger.daemon.profile import reference

    parts = [_SETTINGS, _head("profile", "what it is"), *_profiles()]
    keys = reference.every_key()
    for name, section in reference.sections().items():
        parts.append(f"\n## `[{name}]`\n\n{reference.about(section)}\n\n")
        rows = [key for key in keys if key.section == name]
        if rows:
            parts.append(_head("key", "default", "unit", "allowed", "meaning"))
        for key in rows:
            cells = (f"`{key.name}`", f"`{key.default}`", key.unit, key.allowed, key.meaning)
            parts.append(_row(*cells))
    return "".join(parts)


def _profiles() -> list[str]:
    """A row of the table for each profile that comes with the package."""
    from softfinger.daemon.profile.load import names
    from softfinger.tools.setup.config import subject

    return [_row(f"`{name}`", subject(Path(name))) for name in names()]


# --- the stream -----------------------------------------------------------------------------------


def stream() -> str:
    """Every topic and field, from the schema."""
    from softfinger.daemon.wire.schema_docs import page

    return page()


# --- commands and subcommands ---------------------------------------------------------------------


def commands() -> str:
    """The hand's commands from the table of modes, the command line's words from its parser."""
    from softfinger.daemon.control.modes import COMMANDS, Mode
    from softfinger.daemon.types import UNLEASED
    from softfinger.tools.terminal.send import _EPILOG

    parts = [
        "# Commands to the hand\n\nMsgpack maps on a REQ socket, `softfinger send`, or methods of "
        f"[`Hand`](api.md): the same words.\n\n```text\n{_EPILOG}\n```\n\n",
        _head("command", "numbers", "accepted in the modes", "needs the lease"),
    ]
    for name, (modes, numbers) in COMMANDS.items():
        given = ", ".join(f"`{key}`" + " (may be left out)" * (not numbers[key]) for key in numbers)
        where = "any" if modes == set(Mode) else ", ".join(m for m in Mode if m in modes)
        leased = "no" if name in UNLEASED | {"stop"} else "yes"
        parts.append(_row(f"`{name}`", given, where, leased))
    return "".join(parts)


def command_line() -> str:
    """The help of every subcommand."""
    from softfinger.tools.cli import SUBCOMMANDS, make_parser

    os.environ["COLUMNS"] = "100"  # the width that argparse wraps to
    parser, _ = make_parser(SUBCOMMANDS)
    parts = [f"# The command line\n\n```text\n{parser.format_help()}```\n"]
    for name, subparser in _children(parser).items():
        parts.append(f"\n## {name}\n\n```text\n{subparser.format_help()}```\n")
        for action, inner in _children(subparser).items():
            parts.append(f"\n### {name} {action}\n\n```text\n{inner.format_help()}```\n")
    return "".join(parts)


def _children(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of a parser's subcommands."""
    found: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found |= action.choices
    return found


# --- limits ---------------------------------------------------------------------------------------


_LIMITS = """\
# Limits

What is judged of a running hand, with the built-in one's numbers; `softfinger limits --config FILE`
has a profile's. `warn` is reported, `limit` changes the goal, `fault` turns torque off until
`clear`. *Noticed* counts from the first reading or frame that is past the bound; an age among the
settings comes before it.

"""


def limits() -> str:
    """Every limit: what is judged, how soon, by which settings, and what follows."""
    from softfinger.daemon.profile.settings import Settings
    from softfinger.daemon.safety.limits import LIMITS
    from softfinger.tools.setup.limits import _values

    settings = Settings()
    taking_turns = sum(row.in_turn for row in LIMITS)
    rows = [
        _LIMITS,
        _head("limit", "what is judged", "follows", "noticed", "settings, with their defaults"),
    ]
    for row in LIMITS:
        tick = 1e3 / settings.loop.rate
        lasts = getattr(settings.safety, row.lasts) if isinstance(row.lasts, str) else row.lasts
        after = f"{lasts:g} s + " if lasts else ""
        if row.in_turn:
            turns = 2 if lasts else 1  # to see it, and to see that it has lasted
            when = f"{after}up to {turns * taking_turns * tick:g} ms"
        elif row.check:
            when = f"{after}a tick ({tick:g} ms)"
        else:
            when = "where it is met"
        keys = ", ".join(_values(settings, row))
        rows.append(_row(f"`{row.name}`", row.quantity, row.level, when, keys and f"`{keys}`"))
    return "".join(rows)


# --- events ---------------------------------------------------------------------------------------


_EVENTS = """\
# Events

The daemon reports what happens as events: on the topic [`hand/event`](stream.md), in its log, and
in `softfinger monitor` and `view`. An event has a level, a kind and a text. The text has the
details of the case; this table explains the kinds.

An error whose kind [Limits](limits.md) lists as a `fault` turns torque off. Remove its cause, then
send `clear`.

"""


def events() -> str:
    """Every kind of event, from the table that explains them."""
    from softfinger.daemon.wire.event_kinds import KINDS

    parts = [_EVENTS, _head("kind", "level", "cause", "what to do")]
    for kind, each in KINDS.items():
        parts.append(_row(f"`{kind}`", each.levels, each.cause, each.remedy))
    return "".join(parts)


# --- the interface for programs -------------------------------------------------------------------


def api() -> str:
    """The public names of the package, from their docstrings."""
    import softfinger

    parts = ["# For programs\n\nThe names below are imported from `softfinger` itself.\n"]
    for name in softfinger.__all__:
        if not name.startswith("_"):
            module = softfinger._MODULES.get(name, "softfinger")
            parts.append(f"\n::: {module}.{name}\n")
    parts.append("\n## Checks for authors of plugins\n\n::: softfinger.testing\n")
    return "".join(parts)


# --- tables within pages --------------------------------------------------------------------------


def checkpoints() -> str:
    """Closed forms at a few places."""
    import math

    from softfinger.kinematics.contact.closed_form import closed_forms

    rows = [_head("d [mm]", "θ [°]", "F [N]", "U [mJ]", "∂U/∂d [N]", "∂U/∂θ [mN·m]")]
    for d, theta in ((2, 0), (2, 30), (4, 0), (4, 15), (6, 30), (8, 0), (8, 30)):
        c = closed_forms(0.304e6, 1e-3 * d, math.radians(theta))
        values = c.force, 1e3 * c.energy, c.energy_d, 1e3 * c.energy_theta
        rows.append(_row(str(d), str(theta), *(f"{float(each):.12g}" for each in values)))
    return "".join(rows)


def errata() -> str:
    """Each erratum that `softfinger figures` marks, once."""
    from softfinger.tools.paper.figures import pages

    found = dict.fromkeys(each for page in pages().values() for each in page.errata)
    rows = [_row(each.place, each.printed, each.holds) for each in found]
    return _head("place", "printed", "holds") + "".join(rows)


def servos() -> str:
    """The known models, what they press at the tip, and the bounds to set for them."""
    from softfinger.daemon.servos.control_table import MODELS

    columns = ("V", "stall [N·m at A]", "N·m/A", "force [N]", "current_max [A]", "force_max [N]")
    rows = [_head("`servos.model`", *columns)]
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
        rows.append(_row(f"`{name}`", *cells))
    return "".join(rows)


def measured() -> str:
    """The figures that docs/benchmarks.json keeps, of a `softfinger bench` without names."""
    content = json.loads((ROOT / "docs" / "benchmarks.json").read_text(encoding="utf-8"))
    load = " to ".join(f"{each:.1f}" for each in content["load"])
    parts = [f"{content['machine']}, {content['cores']} cores, load {load}.\n"]
    shown = [row for row in content["rows"] if row["table"] and row.get("median") is not None]
    for title, rows in itertools.groupby(shown, key=lambda row: row["table"]):
        parts.append(
            "\n" + _head(title, "median", "p99", "unit", "aim ≤", "error", "RMS of d [µm]")
        )
        for row in rows:
            keys = ("median", "p99", "unit", "aim ≤", "relative error", "RMS of d [µm]")
            cells = (row.get(key) for key in keys)
            told = ("" if c is None else c if isinstance(c, str) else f"{c:.3g}" for c in cells)
            parts.append(_row(row["name"], *told))
    return "".join(parts)


def published() -> str:
    """The rows of `softfinger validate`, computed anew."""
    from softfinger.tools.paper.validate import FIGURES, comparisons

    rows = [_head("", "quantity", "published", "here", "source", "what stands between")]
    for each in comparisons():
        cells = each.quantity, each.published, each.ours, each.source, each.why
        rows.append(_row(FIGURES[each.verdict], *cells))
    return "".join(rows)


TABLES = {
    "published": published,
    "checkpoints": checkpoints,
    "errata": errata,
    "servos": servos,
    "measured": measured,
}

PAGES: dict[str, Callable[[], str]] = {
    "index.md": _from("README.md"),
    "contributing.md": _from("CONTRIBUTING.md"),
    "changelog.md": _from("CHANGELOG.md"),
    "example.md": _program("tools/examples/grasp_and_turn.py"),
    "configuration.md": configuration,
    "stream.md": stream,
    "commands.md": commands,
    "command-line.md": command_line,
    "limits.md": limits,
    "events.md": events,
    "api.md": api,
}
# Where a link to a file of the project's folder leads to on the site.
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


def on_config(config: Any) -> Any:
    """State the version and the licence at the foot of every page."""
    from softfinger import __version__

    config.copyright = f"softfinger {__version__}, MIT licence"
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that no file in docs/ holds."""
    from mkdocs.structure.files import File

    for name, make in PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Tables made from the code; links as a reader of the repository follows them."""
    markdown = re.sub(
        r"\s*<!-- table: (\w+) -->", lambda found: f"\n\n{TABLES[found[1]]()}", markdown
    )

    def link(found: re.Match[str]) -> str:
        target = found[1].removeprefix("../").removeprefix("docs/")
        return f"]({_LINKS.get(target, target)}{found[2]})"

    return re.sub(r"\]\(((?!https?:)[^)#]+)(#[^)]*|)\)", link, markdown)
