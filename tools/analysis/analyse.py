"""``softfinger analyse FILE``: d, θ, force and energy over time from recorded pressure frames."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.extras import MissingExtra

_EPILOG = """\
FILE is a recording (.mcap), .npz with frames [n, rows, cols] and t, .npy frames or a folder of
them, or a Tekscan-style ASCII export. A recording has its settings in it. For the others, name a
profile by --config, or what the file doesn't have, for instance
  --set tip.radius=0.02 --set tactile.pitch=0.0013 --set tactile.pascal_per_count=4
  --set tactile.noise=500 --set material.law=constant --set material.modulus=3e5
Writes FILE.contacts.csv and FILE.contacts.png (extra 'plot') beside it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE")
    add_profile(parser)
    parser.add_argument("--csv", type=Path, metavar="OUT", help="where to write the numbers")
    parser.add_argument("--plot", type=Path, metavar="OUT", help="where to write the picture")
    parser.add_argument("--no-plot", action="store_true", help="write only the numbers")


def run(arguments: argparse.Namespace) -> int:
    """Analyse and write. Raises SoftfingerError or OSError."""
    settings = profile(arguments)
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.analysis.contacts import analyse, draw, open_source, write_csv
    from softfinger.tools.processes.kernel_build import build_kernels, print_event, table_cache
    from softfinger.tools.terminal.progress import Progress

    build_kernels(settings, print_event, FRAMES)
    path: Path = arguments.file
    table = arguments.csv or path.with_name(path.name + ".contacts.csv")
    own = arguments.config is None and not arguments.set
    source = open_source(path, settings, table_cache(), own)
    began = time.perf_counter()
    with Progress("analyse", source.total) as progress:
        contacts = analyse(source, progress)
    elapsed = time.perf_counter() - began
    write_csv(table, contacts)
    frames = sum(each.t.size for each in contacts)
    touching = sum(int((each.contact & each.valid).sum()) for each in contacts)
    reasons = sum((each.reasons() for each in contacts), Counter[str]())
    print(
        f"{frames} frames in {elapsed:.2f} s ({frames / max(elapsed, 1e-9):.0f} a second): "
        f"{touching} with contact, {reasons.total()} not usable; {table}"
    )
    for reason, count in reasons.most_common():
        print(f"  {count} not usable: {reason}")
    if arguments.no_plot:
        return 0
    picture = arguments.plot or path.with_name(path.name + ".contacts.png")
    try:
        draw(contacts, path.name, picture)
    except MissingExtra as error:
        print(f"analyse: no picture: {error}", file=sys.stderr)
        return 1 if arguments.plot else 0
    print(picture)
    return 0
