"""``softfinger bench``: run time of this very machine, printed as a table and kept as JSON."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from pathlib import Path

MEASUREMENTS = {
    "tick": "one tick without serial",
    "hil": "one tick over the stand-in hand's ptys",
    "startup": "start to the first published state",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``bench``."""
    known = ", ".join(f"{name} ({text})" for name, text in MEASUREMENTS.items())
    parser.add_argument(
        "names", metavar="NAME", nargs="*", help=f"what to measure: {known}; all if none is named"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the JSON file."""
    from tools.benchmarks.report import table

    unknown = [name for name in arguments.names if name not in MEASUREMENTS]
    if unknown:
        known = ", ".join(MEASUREMENTS)
        print(f"bench: found {unknown[0]!r}, expected one of {known}", file=sys.stderr)
        return 2
    rows = []
    for name in arguments.names or MEASUREMENTS:
        print(f"measuring {MEASUREMENTS[name]} …", file=sys.stderr, flush=True)
        rows += importlib.import_module(f"tools.benchmarks.{name}").measure()
    print(table(rows))
    if arguments.json:
        report = {
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "rows": [each.as_dict() for each in rows],
        }
        arguments.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return 0
