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
from softfinger.tools.sweep import Sweep, add_sweep

_EPILOG = """\
FILE is a recording (.mcap), .npz with frames [n, rows, cols] and t, .npy frames or a folder of
them, or a Tekscan-style ASCII export. A recording has its settings in it. For the others, name a
profile by --config, or what the file doesn't have, for instance
  --set tip.radius=0.02 --set tactile.pitch=0.0013 --set tactile.pascal_per_count=4
  --set tactile.noise=500 --set material.law=constant --set material.modulus=3e5
Writes FILE.contacts.csv beside it, which PlotJuggler draws. Several files are analysed side by
side, one on each processor."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    add_profile(parser)
    parser.add_argument("--csv", type=Path, metavar="OUT", help="where to write the numbers")
    add_sweep(parser)


def run(arguments: argparse.Namespace) -> int:
    """Analyse and write. Raises SoftfingerError or OSError where there is one file."""
    settings, files = profile(arguments), arguments.files
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.processes.kernel_build import build_kernels, print_event

    build_kernels(settings, print_event, FRAMES)
    if len(files) == 1:
        print(_analysed(arguments, settings, files[0]), end="")
        return 0
    if arguments.csv:
        print("analyse: --csv goes with one FILE", file=sys.stderr)
        return 2
    status = 0
    found = Sweep("analyse", partial(_one_of_many, arguments, settings), files)
    for told, complaint in found.run(arguments.processes, arguments.scheduler):
        print(told, end="", flush=True)
        print(complaint, end="", file=sys.stderr, flush=True)
        status |= bool(complaint)
    return status


def _one_of_many(arguments: argparse.Namespace, settings: Settings, path: Path) -> tuple[str, str]:
    """Analyse one, and return what is printed and what is wrong with it, which ends no other."""
    try:
        return _analysed(arguments, settings, path), ""
    except (SoftfingerError, OSError) as error:
        return "", f"analyse: {error}\n"


def _analysed(arguments: argparse.Namespace, settings: Settings, path: Path) -> str:
    from softfinger.tools.analysis.contacts import analyse, open_source, write_csv
    from softfinger.tools.terminal.progress import Progress

    path = path if path.name else path.resolve()  # "." has no name
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
    return told
