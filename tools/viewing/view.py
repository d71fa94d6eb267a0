"""``softfinger view``: the stream, or a recording, in Rerun's viewer; the stream in Foxglove."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from softfinger.tools.arguments import add_range, add_stream, megabytes, number, seconds
from softfinger.tools.ending import Ending
from softfinger.tools.extras import require

_EPILOG = """\
Opens Rerun's window, or with --web a page on this machine; with --save alone, neither.
With --foxglove: a WebSocket server for Foxglove on this machine, by default at ws://127.0.0.1:8765;
the line it prints says where the layout file is. A recording is opened in Foxglove itself.
Ends with Ctrl-C, when the window is closed, or after --duration.
From another machine: ssh -L 9090:127.0.0.1:9090 -L PORT:127.0.0.1:PORT, with the two ports printed.
Exit status: 0, or 1 with the reason when nothing could be shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument(
        "file", type=Path, nargs="?", metavar="FILE.mcap", help="a recording, instead of the stream"
    )
    add_stream(parser)
    parser.add_argument("--web", action="store_true", help="in the browser, instead of a window")
    parser.add_argument(
        "--foxglove",
        type=_any_port,
        nargs="?",
        const=8765,
        metavar="PORT",
        help="serve the stream to Foxglove (default: 8765; 0: a free port)",
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")
    parser.add_argument(
        "--port", type=_port, metavar="N", help="the page's port (default: 9090 or a free one)"
    )
    parser.add_argument(
        "--save", type=Path, metavar="FILE.rrd", help="write it to this new file, too"
    )
    parser.add_argument(
        "--memory",
        type=megabytes,
        default=500.0,
        metavar="MB",
        help="memory for the newest data (default 500); a page opened late on a stream gets 1",
    )
    parser.add_argument(
        "--rate",
        type=_rate,
        default=20.0,
        metavar="HZ",
        help="pictures a second at most (default 20)",
    )
    parser.add_argument("--duration", type=seconds, metavar="S", help="end after S seconds")
    add_range(parser)


def _port(text: str) -> int:
    return int(number(text, "a port, 1 to 65535", 0.0, 65535.0))


def _any_port(text: str) -> int:
    return int(number(text, "a port, 0 to 65535", 0.0, 65535.0, includes_low=True))


def _rate(text: str) -> float:
    return number(text, "0.1 to 100 Hz", 0.1, 100.0, includes_low=True)


def run(arguments: argparse.Namespace) -> int:
    """Show until the end. Raises SoftfingerError when nothing can be shown."""
    os.environ.setdefault("RUST_LOG", "off")  # this command reports errors itself, in one line
    if arguments.foxglove is not None:
        return _serve(arguments)
    require("view")
    from softfinger.tools.viewing.session import Session

    with Ending(arguments.duration) as ending:
        Session(arguments, ending).show()
    return 0


def _serve(arguments: argparse.Namespace) -> int:
    others = {"FILE.mcap": arguments.file, "--web": arguments.web, "--save": arguments.save}
    for name, value in others.items():
        if value:
            print(f"view: --foxglove serves the stream alone, found {name}, too", file=sys.stderr)
            return 2
    require("foxglove")
    from softfinger.tools.viewing.foxglove_server import serve

    with Ending(arguments.duration) as ending:
        serve(arguments, ending)
    return 0
