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

from softfinger.daemon.wire.own_files import write_text

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
    "faults": "every fault on the stand-in hand and what comes of it, an hour for 100 trials each",
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
    parser.add_argument(
        "--trials", type=_count, default=100, metavar="N", help="of each fault, for faults"
    )
    parser.add_argument(
        "--only", default="", metavar="PATTERN", help="faults whose name it is found in, for faults"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw what has a picture: contact (extra 'plot')"
    )


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the JSON file."""
    from softfinger.tools.benchmarks.report import Row, table

    names = arguments.names or list(MEASUREMENTS)
    texts = MEASUREMENTS | ON_DEMAND
    unknown = [name for name in names if name not in texts]
    if unknown:
        known = ", ".join(texts)
        print(f"bench: found {unknown[0]!r}, expected one of {known}", file=sys.stderr)
        return 2
    modules = {
        name: importlib.import_module(f"softfinger.tools.benchmarks.{name}") for name in names
    }
    if "faults" in modules and not modules["faults"].known(arguments.only):
        print(f"bench: --only {arguments.only}: it is found in no fault's name", file=sys.stderr)
        return 2
    if arguments.plot and (reason := _no_plot(modules)):
        print(f"bench: {reason}", file=sys.stderr)
        return 2
    report, plain, failed = [], [], False
    for name, module in modules.items():
        print(f"measuring {texts[name]} …", file=sys.stderr, flush=True)
        options = {key: getattr(arguments, key) for key in getattr(module, "OPTIONS", ())}
        rows = module.measure(**options)
        report += [{"measurement": name, **each.as_dict()} for each in rows]
        plain += [each for each in rows if isinstance(each, Row)]
        own = [each for each in rows if not isinstance(each, Row)]
        failed = failed or any(getattr(each, "failed", False) for each in own)
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
        with write_text(arguments.json) as file:
            file.write(json.dumps(content, indent=2) + "\n")
    return 1 if failed else 0


def _count(text: str) -> int:
    """A whole number above 0. Raises ArgumentTypeError with what was found."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, found {text!r}")
    return int(text)


def _no_plot(modules: dict[str, ModuleType]) -> str:
    """Why ``--plot`` can't be served, known before anything is measured; empty when it can."""
    from softfinger.tools.paper.style import NoMatplotlib, settings

    if not any(hasattr(module, "plot") for module in modules.values()):
        return "--plot: none of the named measurements has a picture"
    try:
        settings()
    except NoMatplotlib as error:
        return f"--plot: {error}"
    return ""
