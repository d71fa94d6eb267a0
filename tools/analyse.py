"""``softfinger analyse FILE``: d, θ, force and energy over time from recorded pressure frames."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.errors import RecordingError, SettingsError
from softfinger.tools.arguments import add_profile, profile

if TYPE_CHECKING:
    from softfinger.tools.analysis.contacts import Contacts

_EPILOG = """\
FILE is a recording (.mcap), .npz with frames [n, rows, cols] and t, a folder of .npy frames, or a
Tekscan-style ASCII export. A recording brings its settings along. For the others, tell what the
file doesn't: a profile by --config, or for instance
  --set tip.radius=0.02 --set tactile.pitch=0.0013 --set tactile.pascal_per_count=4
  --set tactile.noise=500 --set material.law=constant --set material.modulus=3e5
Writes FILE.contacts.csv and FILE.contacts.png (extra 'plot') beside it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``analyse``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE")
    add_profile(parser)
    parser.add_argument("--csv", type=Path, metavar="OUT", help="where the numbers go")
    parser.add_argument("--plot", type=Path, metavar="OUT", help="where the picture goes")
    parser.add_argument("--no-plot", action="store_true", help="numbers alone")


def run(arguments: argparse.Namespace) -> int:
    """Analyse and write; 1 with one line when the file is no good, 2 for wrong settings."""
    try:
        settings = profile(arguments)
    except SettingsError as error:
        print(error, file=sys.stderr)
        return 2
    from softfinger.daemon.errors import RecordingError as FramesError
    from softfinger.daemon.errors import TactileError
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.tools.analysis.contacts import analyse, write_csv
    from softfinger.tools.analysis.sources import open_source
    from softfinger.tools.processes.kernel_build import build_kernels, print_event, table_cache
    from softfinger.tools.terminal.progress import Progress

    build_kernels(settings, print_event, FRAMES)
    path: Path = arguments.file
    own = arguments.config is None and not arguments.set
    base = Path(str(path).rstrip("/"))
    table = arguments.csv or base.with_name(base.name + ".contacts.csv")
    try:
        source = open_source(path, settings, table_cache(), own)
        began = time.perf_counter()
        with Progress("analyse", source.total) as progress:
            contacts = analyse(source, progress)
        elapsed = time.perf_counter() - began
        write_csv(table, contacts)
    except (RecordingError, FramesError, SettingsError, TactileError) as error:
        text = str(error)
        print(f"analyse: {text if str(path) in text else f'{path}: {text}'}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"analyse: {table}: {error.strerror}", file=sys.stderr)
        return 1
    frames = sum(each.t.size for each in contacts)
    touching = sum(int((each.contact & each.valid).sum()) for each in contacts)
    unsound = sum(int((~each.valid).sum()) for each in contacts)
    rate = frames / max(elapsed, 1e-9)
    print(
        f"{frames} frames in {elapsed:.2f} s ({rate:.0f} a second): {touching} with contact, ",
        end="",
    )
    print(f"{unsound} not usable; {table}")
    return 0 if arguments.no_plot else _draw(contacts, arguments, base)


def _draw(contacts: list[Contacts], arguments: argparse.Namespace, base: Path) -> int:
    from softfinger.tools.analysis.pictures import draw
    from softfinger.tools.paper.style import NoMatplotlib

    picture = arguments.plot or base.with_name(base.name + ".contacts.png")
    try:
        draw(contacts, base.name, picture)
    except NoMatplotlib as error:
        print(f"analyse: no picture; {error}", file=sys.stderr)
        return 1 if arguments.plot else 0
    except (OSError, ValueError) as error:
        print(f"analyse: {picture}: {error}", file=sys.stderr)
        return 1
    print(picture)
    return 0
