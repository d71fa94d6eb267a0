"""``softfinger plot FILE.mcap``: a recording's pictures for a paper or a lab book."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from softfinger.daemon.errors import RecordingError
from softfinger.tools.arguments import moment, seconds, teller

# Beside each other in help, so that a page can be chosen without drawing all.
PAGES = {
    "time": "force, energy, displacement and the object's angle over time, with their targets",
    "angle": "force and energy against θ beside the model's curves",
    "landscape": "the path over U(d, θ) with its local minimum",
    "error": "estimate less truth within ± 2σ, where a simulated hand knows it",
    "joints": "joint angles and currents with their goals, temperatures",
    "timing": "histograms of tick, compute and wake-up times",
}
FORMATS = ("png", "svg", "pdf")

_EPILOG = "pages:\n" + "\n".join(f"  {name:10} {what}" for name, what in PAGES.items())
_EPILOG += """

A page that needs what the recording lacks is left out with a word. Needs the extra 'plot'.
Exit status: 0 when at least one page was drawn."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``plot``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where to, made if missing (default: FILE.plots)"
    )
    parser.add_argument(
        "--pages", nargs="+", choices=tuple(PAGES), metavar="PAGE", help="which (default: all)"
    )
    parser.add_argument(
        "--format", nargs="+", choices=FORMATS, default=["png"], help="one or several"
    )
    parser.add_argument("--from", type=moment, metavar="S", dest="start", help="from S seconds on")
    parser.add_argument("--to", type=seconds, metavar="S", dest="end", help="up to S seconds")


def run(arguments: argparse.Namespace) -> int:
    """Draw; 1 with one line when the recording, the folder or an extra is no good."""
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.daemon.profile.settings import Settings
    from softfinger.tools.analysis.plots import draw
    from softfinger.tools.analysis.plots_data import load_run
    from softfinger.tools.paper import style
    from softfinger.tools.processes.kernel_build import build_kernels, print_event, table_cache
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.terminal.progress import Progress

    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".plots")
    names = [name for name in PAGES if name in (arguments.pages or PAGES)]
    start = -math.inf if arguments.start is None else arguments.start
    end = math.inf if arguments.end is None else arguments.end
    drawn = 0
    try:
        with style.settings():
            pass  # before a long recording is read: is there anything to draw with?
        recording = Recording(path, teller("plot"))
        build_kernels(Settings(), print_event, FRAMES)
        with Progress("plot", recording.size) as progress:
            held = load_run(recording, start, end, table_cache(), progress)
        folder.mkdir(parents=True, exist_ok=True)
        for name, file, why in draw(held, names, arguments.format, folder):
            if file is None:
                print(f"plot: page {name} left out: {why}", file=sys.stderr)
            else:
                print(file)
                drawn += 1
    except (RecordingError, style.NoMatplotlib) as error:
        print(f"plot: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"plot: {error.filename or folder}: {error.strerror}", file=sys.stderr)
        return 1
    return 0 if drawn else 1
