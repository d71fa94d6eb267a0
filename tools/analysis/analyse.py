"""``softfinger analyse FILE``: d, θ, force and energy over time from recorded pressure frames."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.extras import MissingExtra
from softfinger.tools.sweep import Sweep, add_sweep

Analysed = tuple[int, str, str]  # exit status, what is said, what is complained about

_EPILOG = """\
FILE is a recording (.mcap), .npz with frames [n, rows, cols] and t, .npy frames or a folder of
them, or a Tekscan-style ASCII export. A recording has its settings in it. For the others, name a
profile by --config, or what the file doesn't have, for instance
  --set tip.radius=0.02 --set tactile.pitch=0.0013 --set tactile.pascal_per_count=4
  --set tactile.noise=500 --set material.law=constant --set material.modulus=3e5
Writes FILE.contacts.csv and FILE.contacts.png (extra 'plot') beside it. Several files are analysed
side by side, one on each processor."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    add_profile(parser)
    parser.add_argument("--csv", type=Path, metavar="OUT", help="where to write the numbers")
    parser.add_argument("--plot", type=Path, metavar="OUT", help="where to write the picture")
    parser.add_argument("--no-plot", action="store_true", help="write only the numbers")
    add_sweep(parser)


def run(arguments: argparse.Namespace) -> int:
    """Analyse and write. Raises SoftfingerError or OSError where there is one file."""
    settings, files = profile(arguments), arguments.files
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.processes.kernel_build import build_kernels, print_event

    build_kernels(settings, print_event, FRAMES)
    if len(files) == 1:
        return _printed(*_analysed(arguments, settings, files[0]))
    if arguments.csv or arguments.plot:
        print("analyse: --csv and --plot go with one FILE", file=sys.stderr)
        return 2
    found = Sweep("analyse", partial(_one_of_many, arguments, settings), files)
    processes = arguments.processes
    return max([_printed(*each) for each in found.run(processes, arguments.scheduler)])


def _printed(status: int, told: str, complaint: str) -> int:
    print(told, end="", flush=True)
    print(complaint, end="", file=sys.stderr, flush=True)
    return status


def _one_of_many(arguments: argparse.Namespace, settings: Settings, path: Path) -> Analysed:
    """Analyse one; what is wrong with it ends no other."""
    try:
        return _analysed(arguments, settings, path)
    except (SoftfingerError, OSError) as error:
        return 1, "", f"analyse: {error}\n"


def _analysed(arguments: argparse.Namespace, settings: Settings, path: Path) -> Analysed:
    from softfinger.tools.analysis.contacts import analyse, draw, open_source, write_csv
    from softfinger.tools.terminal.progress import Progress

    table = arguments.csv or path.with_name(path.name + ".contacts.csv")
    own = arguments.config is None and not arguments.set
    source = open_source(path, settings, own)
    began = time.perf_counter()
    with Progress("analyse", source.total) as progress:
        contacts = analyse(source, progress)
    elapsed = time.perf_counter() - began
    write_csv(table, contacts)
    frames = sum(each.t.size for each in contacts)
    touching = sum(int((each.contact & each.valid).sum()) for each in contacts)
    reasons = sum((each.reasons() for each in contacts), Counter[str]())
    told = (
        f"{frames} frames in {elapsed:.2f} s ({frames / max(elapsed, 1e-9):.0f} a second): "
        f"{touching} with contact, {reasons.total()} not usable; {table}\n"
    )
    told += "".join(f"  {n} not usable: {reason}\n" for reason, n in reasons.most_common())
    if arguments.no_plot:
        return 0, told, ""
    picture = arguments.plot or path.with_name(path.name + ".contacts.png")
    try:
        draw(contacts, path.name, picture)
    except MissingExtra as error:
        return 1 if arguments.plot else 0, told, f"analyse: no picture: {error}\n"
    return 0, f"{told}{picture}\n", ""
