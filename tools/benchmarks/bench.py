"""``softfinger bench``: run time of this very machine, printed as tables and kept as JSON."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from softfinger.daemon.own_files import write_text

if TYPE_CHECKING:
    from softfinger.tools.benchmarks.framework.report import Report, Row

MEASUREMENTS = {
    "contact": "the contact model, run time against error, beside SciPy",
    "estimator": "pressure grid to d and tilt, run time against error, beside OpenCV and others",
    "tick": "one tick without serial",
    "scenes": "the tick of each kind of scene, and what each skipping step saves",
    "control": "grasping, turning and holding on the simulated hand",
    "servos": "read + write of two servos over a pty, beside the plain SDK",
    "hil": "one tick over the emulated hand's ptys",
    "reflex": "from a slip's onset to the servos' bytes",
    "wakeup": "wake-ups of the loop beside cyclictest and time.sleep",
    "startup": "start to the first published state, memory",
}
CAMPAIGNS = {
    "accuracy": "the estimator over its whole envelope against the Cramér-Rao bound, ten minutes",
    "faults": "every fault on the emulated hand and what comes of it, an hour for 100 trials each",
}
PAGE = ("contact", "estimator", "tick", "servos", "hil", "wakeup", "startup")
_PAGE_COLUMNS = ("median", "p99", "unit", "aim ≤")
_CAMPAIGN = "campaign"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    single = ", ".join(f"{name} ({text})" for name, text in MEASUREMENTS.items())
    long = ", ".join(f"{name} ({text})" for name, text in CAMPAIGNS.items())
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help=f"what to measure: {single}; without a name one page of the figures that matter, in "
        f"some two minutes; or '{_CAMPAIGN}' and one of {long}",
    )
    parser.add_argument(
        "--trials", type=_count, metavar="N", help="trials of each case of a campaign"
    )
    parser.add_argument(
        "--only", default="", metavar="PATTERN", help="cases of a campaign with this in their name"
    )
    parser.add_argument(
        "--brief", action="store_true", help="fewer cases of each NAME, as for the page"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw run time against error (extra 'plot')"
    )
    parser.add_argument(
        "--against", type=Path, metavar="OLD.json", help="show what is slower than in that file"
    )


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the files that were asked for."""
    from softfinger.tools.benchmarks.framework.report import Report, slower, yardstick

    campaign = arguments.names[:1] == [_CAMPAIGN]
    texts = CAMPAIGNS if campaign else MEASUREMENTS
    names = arguments.names[1:] if campaign else arguments.names or list(PAGE)
    try:
        _check(names, texts, arguments)
        old = _read(arguments.against) if arguments.against else []
    except ValueError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    rows: list[Row] = []
    drawn: list[Report] = []
    page: list[Row] = []
    failed = False
    for name in names:
        print(f"measuring {texts[name]} …", file=sys.stderr, flush=True)
        module = _module(name)
        try:
            if campaign:
                tables = module.measure(arguments.trials, arguments.only)
            else:
                tables = module.measure(brief=arguments.brief or not arguments.names)
        except RuntimeError as error:  # on a busy machine a hand may let go
            print(f"bench: {name}: {error}", file=sys.stderr)
            failed = True
            continue
        for table in [*tables, Report("", [yardstick()])]:
            head = {"measurement": name, "table": table.title}
            # JSON knows no NaN, which alone differs from itself.
            rows += [
                head | {key: None if value != value else value for key, value in row.items()}
                for row in table.rows
            ]
            failed = failed or table.failed
        drawn += [table for table in tables if table.error]
        if arguments.names:
            print(*tables, sep="\n\n", end="\n\n")
        else:
            page += _key_figures(tables, module.PAGE)
    if page:
        print(Report("", page))
    if arguments.json:
        content = {
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "rows": rows,
        }
        with write_text(arguments.json) as file:
            file.write(json.dumps(content, indent=2) + "\n")
    if arguments.plot:
        from softfinger.tools.benchmarks.framework.report import draw

        draw(drawn, arguments.plot)
    if old:
        print(slower(old, rows))
    return 1 if failed else 0


def _module(name: str) -> ModuleType:
    room = "benchmarks.campaigns" if name in CAMPAIGNS else "benchmarks"
    return importlib.import_module(f"softfinger.tools.{room}.{name}")


def _check(names: list[str], texts: dict[str, str], arguments: argparse.Namespace) -> None:
    """What can be refused before anything is measured. Raises ValueError."""
    if not names:
        raise ValueError(f"'{_CAMPAIGN}' alone, expected one of {', '.join(texts)} after it")
    for name in names:
        if name not in texts:
            hint = f": it is a campaign, `bench {_CAMPAIGN} {name}`" if name in CAMPAIGNS else ""
            raise ValueError(f"found {name!r}, expected one of {', '.join(texts)}{hint}")
        if texts is CAMPAIGNS and not _module(name).known(arguments.only):
            raise ValueError(f"--only {arguments.only}: no case of {name} has this in its name")
    if arguments.plot:
        from softfinger.tools.extras import MissingExtra
        from softfinger.tools.style import settings

        if not {"contact", "estimator"} & set(names):
            raise ValueError("--plot: only contact and estimator have a picture")
        try:
            settings()
        except MissingExtra as error:
            raise ValueError(f"--plot: {error}") from None


def _read(path: Path) -> list[Row]:
    """The rows of an earlier run. Raises ValueError."""
    try:
        found: list[Row] = json.loads(path.read_text(encoding="utf-8"))["rows"]
        if not all({"measurement", "table", "name"} <= row.keys() for row in found):
            raise KeyError("rows")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"--against {path}: no figures of `bench --json`: {error}") from None
    return found


def _key_figures(tables: list[Report], chosen: dict[str, tuple[str, ...]]) -> list[Row]:
    """Rows of the page: those whose names begin as ``chosen`` has it, by the table's title."""
    return [
        {"name": f"{table.title}: {row['name']}"}
        | {key: row.get(key) for key in (*_PAGE_COLUMNS, table.error) if key}
        for table in tables
        for row in table.rows
        if str(row["name"]).startswith(chosen.get(table.title, ()))
    ]


def _count(text: str) -> int:
    """A whole number above 0. Raises ArgumentTypeError with what was found."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, found {text!r}")
    return int(text)
