"""Run ``softfinger bench``: run benchmarks, print tables and write JSON."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.own_files import write_text
from softfinger.tools.arguments import number
from softfinger.tools.sweep import Sweep, add_sweep

if TYPE_CHECKING:
    from softfinger.tools.benchmarks.measuring import Report, Row

MEASUREMENTS = {
    "estimator": (
        "run time and error of force and energy lookups, and of d and tilt estimates from frames"
    ),
    "tick": "run time of ticks, in one process and over ptys",
    "control": "remaining object angle error for each grip law",
    "reflex": "response to sudden load increases: success, slip distance and reaction time",
    "faults": "true grip force with faulty measurements (15 minutes)",
    "robustness": "true grip force of hands that differ from their settings",
}
# These benchmarks run in virtual time, so other programs do not affect their results.
SWEPT = ("reflex", "faults", "robustness")
PAGE = ("estimator", "tick")
PAGE_COLUMNS = ("median", "p99", "unit", "aim ≤", "relative error", "RMS of d [µm]")
_CASES = ("faults", "robustness")
# Options that apply only to some measurements.
_OWN = {"full": ("reflex",), "trials": _CASES, "only": _CASES}
FAILED = 1  # exit status of a failed benchmark; 2 means invalid arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    known = ", ".join(f"{name} ({text})" for name, text in MEASUREMENTS.items())
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help=f"what to measure: {known}; by default, print one page with the main results, which "
        "takes about a minute",
    )
    parser.add_argument(
        "--trials",
        type=_trials,
        metavar="N",
        help=f"number of trials per case of {' and '.join(_CASES)}",
    )
    parser.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="run only the cases whose name contains this text",
    )
    parser.add_argument("--brief", action="store_true", help="run fewer cases of each NAME")
    parser.add_argument(
        "--full", action="store_true", help="apply all loads of 'reflex', not only a few"
    )
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write the results as JSON; after an interruption by Ctrl-C, the same command resumes "
        f"the run ({', '.join(SWEPT)})",
    )
    add_sweep(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the measurements, print and write the results, and return the exit status."""
    from softfinger.tools.benchmarks.measuring import Report

    names = arguments.names or list(PAGE)
    try:
        _check(names, arguments)
    except ValueError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    machine = _processor()
    load = [os.getloadavg()[0]]
    rows: list[Row] = []
    tables: list[Report] = []
    status = 0
    for name in names:
        print(f"measuring {MEASUREMENTS[name]}", file=sys.stderr, flush=True)
        found = _measured(name, arguments)
        rows += _kept(name, found)
        if any(table.failed for table in found) or not found:
            status = FAILED
        if arguments.names:
            print(*found, sep="\n\n", end="\n\n")
        tables += found
    load.append(os.getloadavg()[0])
    if not arguments.names:
        title = f"{machine}, {os.cpu_count()} cores, load {load[0]:.1f} to {load[1]:.1f}"
        print(Report(title, _page(tables)))
    if arguments.json:
        about = {"machine": machine, "cores": os.cpu_count(), "load": load}
        content = about | {"python": platform.python_version(), "rows": rows}
        with write_text(arguments.json) as file:
            file.write(json.dumps(content, indent=2) + "\n")
        for name in names:
            _journal(arguments.json, name).unlink(missing_ok=True)
    return status


def _journal(file: Path, name: str) -> Path:
    return file.with_name(f"{file.name}.{name}.part")


def _measured(name: str, arguments: argparse.Namespace) -> list[Report]:
    """Run a measurement and return its tables, or an empty list after a failure."""
    tables: list[Report] = []
    more = {key: getattr(arguments, key) for key, of in _OWN.items() if name in of}
    if name in SWEPT:

        def sweep(work: Callable[[Any], Any], cases: list[Any]) -> Iterator[Any]:
            journal = _journal(arguments.json, name) if arguments.json else None
            return Sweep(name, work, cases, journal).run(arguments.processes, arguments.scheduler)

        more["sweep"] = sweep
    try:
        tables = _module(name).measure(brief=arguments.brief or not arguments.names, **more)
        if not tables:
            raise RuntimeError(
                f"--only {arguments.only}: no case was run; omit --brief, or increase --trials"
            )
    # A benchmark may fail, for example because a grip was lost on a busy machine.
    except (RuntimeError, SoftfingerError) as error:
        print(f"bench: {name}: {error}", file=sys.stderr)
    for table in tables:
        for note in table.notes if table.failed else ():
            print(f"bench: {name}: {note}", file=sys.stderr)
    return tables


def _kept(name: str, tables: list[Report]) -> list[Row]:
    """Convert the rows of all tables to JSON values, and replace NaN and infinity with null."""
    return [
        {"measurement": name, "table": table.title}
        | {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in row.items()
        }
        for table in tables
        for row in table.rows
    ]


def _page(tables: list[Report]) -> list[Row]:
    return [
        {"name": f"{table.title}: {row['name']}"} | {key: row.get(key) for key in PAGE_COLUMNS}
        for table in tables
        for row in table.rows
    ]


def _processor() -> str:
    """Return the processor name reported by Linux, or the machine type on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


def _trials(text: str) -> int:
    return int(number("a whole number above 0", 1.0, includes_low=True)(text))


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"softfinger.tools.benchmarks.{name}")


def _check(names: list[str], arguments: argparse.Namespace) -> None:
    """Raise ValueError if the arguments are invalid."""
    for key, of in _OWN.items():
        if getattr(arguments, key) and (len(names) != 1 or names[0] not in of):
            raise ValueError(f"--{key}: valid only for {' or '.join(of)}")
    for name in names:
        if name not in MEASUREMENTS:
            raise ValueError(f"found {name!r}, expected one of {', '.join(MEASUREMENTS)}")
    if arguments.only and not any(arguments.only in case for case in _module(names[0]).NAMES):
        raise ValueError(
            f"--only {arguments.only}: no case in {names[0]} has a name that contains this text"
        )
