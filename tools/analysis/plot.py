"""``softfinger plot FILE.mcap``: a recording beside the contact model.

What is drawn over time is left to programs that open the file, Foxglove and PlotJuggler.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.tools.arguments import add_range, to_stderr
from softfinger.tools.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from softfinger.tools.analysis.plots import RecordedRun

PAGES = {
    "angle": "force and energy against θ beside the model's curves",
    "landscape": "the path over U(d, θ) with its local minimum",
}

_EPILOG = "pages:\n" + "\n".join(f"  {name:10} {what}" for name, what in PAGES.items())
_EPILOG += """

A page whose data the recording lacks is left out, with the reason. Needs the extra 'plot'.
Foxglove and PlotJuggler open the file, too, and draw any field over time.
Exit status: 0 when at least one page was drawn."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default: FILE.plots)"
    )
    parser.add_argument(
        "--pages",
        nargs="+",
        choices=tuple(PAGES),
        metavar="PAGE",
        help="pages to draw (default: all)",
    )
    parser.add_argument(
        "--format",
        nargs="+",
        choices=("png", "svg", "pdf"),
        default=["png"],
        help="of the files (default: png)",
    )
    add_range(parser)


def pages() -> dict[str, Callable[[RecordedRun], Figure]]:
    """Return the function that draws each page; matplotlib is imported when one is drawn."""
    from softfinger.tools.analysis.plots import draw_angle, draw_landscape

    return dict(zip(PAGES, (draw_angle, draw_landscape), strict=True))


def run(arguments: argparse.Namespace) -> int:
    """Draw; 1 when no page was drawn. Raises RecordingError, MissingExtra or OSError."""
    require("plot")  # before a long recording is read
    from softfinger.daemon.loop.warm_up import FRAMES
    from softfinger.daemon.profile.settings import Settings
    from softfinger.tools import style
    from softfinger.tools.analysis.plots import Missing, load_run
    from softfinger.tools.processes.kernel_build import build_kernels, print_event
    from softfinger.tools.recordings.reader import Recording
    from softfinger.tools.terminal.progress import Progress

    draws = pages()
    path: Path = arguments.file
    folder = arguments.out or path.with_name(path.name + ".plots")
    recording = Recording(path, to_stderr("plot"))
    build_kernels(Settings(), print_event, FRAMES)
    with Progress("plot", recording.size) as progress:
        data = load_run(recording, arguments.start, arguments.end, progress)
    folder.mkdir(parents=True, exist_ok=True)
    drawn = 0
    with style.settings():
        for name in (name for name in PAGES if name in (arguments.pages or PAGES)):
            try:
                figure = draws[name](data)
            except Missing as missing:
                print(f"plot: page {name} left out: {missing}", file=sys.stderr)
                continue
            for suffix in arguments.format:
                style.save(figure, folder / f"{name}.{suffix}")
                print(folder / f"{name}.{suffix}")
            drawn += 1
    return 0 if drawn else 1
