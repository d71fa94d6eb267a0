"""``softfinger bench``: run time of this very machine, printed as a table and kept as JSON."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from pathlib import Path
from types import ModuleType

MEASUREMENTS = {
    "contact": "the contact model, run time against error",
    "estimator": "pressure grid to d and tilt, run time against error",
    "tick": "one tick without serial",
    "scenes": "the tick of each kind of scene, and what each skipping step saves",
    "control": "grasping, turning and holding on the simulated hand",
    "servos": "read + write of two servos over a pty, beside the plain SDK",
    "hil": "one tick over the stand-in hand's ptys",
    "startup": "start to the first published state",
}
# Too long for a run that names nothing.
ON_DEMAND = {
    "sustained": "a minute of 500 Hz on two servos at 2 Mbaud",
    "wakeup": "wake-ups of the loop beside cyclictest and time.sleep, three minutes",
    "recording": "ten readers and a recorder at 1 kHz for ten minutes; recordings read again",
    "neighbours": "the tick beside busy processes, many subscribers and noisy sensors",
    "accuracy": "the estimator over its whole envelope against the Cramér-Rao bound, ten minutes",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``bench``."""
    known = ", ".join(f"{name} ({text})" for name, text in MEASUREMENTS.items())
    more = ", ".join(f"{name} ({text})" for name, text in ON_DEMAND.items())
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help=f"what to measure: {known}; all of these if none is named; or {more}",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw what has a picture: contact (extra 'plot')"
    )


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the JSON file."""
    from tools.benchmarks.report import Row, table

    names = arguments.names or list(MEASUREMENTS)
    texts = MEASUREMENTS | ON_DEMAND
    unknown = [name for name in names if name not in texts]
    if unknown:
        known = ", ".join(texts)
        print(f"bench: found {unknown[0]!r}, expected one of {known}", file=sys.stderr)
        return 2
    modules = {name: importlib.import_module(f"tools.benchmarks.{name}") for name in names}
    if arguments.plot and (reason := _no_plot(modules)):
        print(f"bench: {reason}", file=sys.stderr)
        return 2
    report, plain = [], []
    for name, module in modules.items():
        print(f"measuring {texts[name]} …", file=sys.stderr, flush=True)
        rows = module.measure()
        report += [{"measurement": name, **each.as_dict()} for each in rows]
        plain += [each for each in rows if isinstance(each, Row)]
        own = [each for each in rows if not isinstance(each, Row)]
        if own:
            print(module.table(own), end="\n\n")
        if own and arguments.plot:
            module.plot(own, arguments.plot)
    if plain:
        print(table(plain))
    if arguments.json:
        content = {
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "rows": report,
        }
        arguments.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0


def _no_plot(modules: dict[str, ModuleType]) -> str:
    """Why ``--plot`` can't be served, known before anything is measured; empty when it can."""
    from tools.figure_pages.style import NoMatplotlib, settings

    if not any(hasattr(module, "plot") for module in modules.values()):
        return "--plot: none of the named measurements has a picture"
    try:
        settings()
    except NoMatplotlib as error:
        return f"--plot: {error}"
    return ""
