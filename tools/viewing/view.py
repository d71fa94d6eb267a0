"""Run ``softfinger view``: show the hand or a recording on a web page, and serve Foxglove."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.daemon.errors import SettingsError
from softfinger.tools.arguments import add_stream, number, seconds
from softfinger.tools.extras import require
from softfinger.tools.stop_condition import StopCondition

_EPILOG = """\
Serves a web page for browsers on this machine. The printed address with the token opens a page with
buttons and sliders, where the space key stops the hand. Without the token, the page only shows the
hand. If this machine has a display, the page is also opened in a browser.
With --foxglove, the stream is also served to Foxglove, by default at ws://127.0.0.1:8765; the
printed line names the layout file. Recordings can be opened directly in Foxglove.
The server stops on Ctrl-C, or after --duration.
From another machine, use ssh -L 9090:127.0.0.1:9090 with the printed port, or --host ADDRESS on a
trusted network. Each address printed with --host opens the page in one browser.
Exit status: 0 success; 1 nothing could be shown (the reason is printed)."""
_PORT = number("a port, 0 to 65535", 0.0, 65535.0, includes_low=True, kind=int)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument(
        "file",
        type=Path,
        nargs="?",
        metavar="FILE.mcap",
        help="show a recording instead of the stream",
    )
    parser.add_argument(
        "--save",
        type=_saved,
        metavar="OUT",
        help="save the recording and exit; OUT.html is a page that plays the recording without "
        "softfinger, OUT.svg is an animated picture of the hand",
    )
    add_stream(parser)
    parser.add_argument(
        "--foxglove",
        type=_PORT,
        nargs="?",
        const=8765,
        metavar="PORT",
        help="serve the stream to Foxglove (default port: 8765; 0: a free port)",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address on which to serve; 0.0.0.0 for all addresses of this machine (default: "
        "127.0.0.1, for browsers on this machine only)",
    )
    parser.add_argument(
        "--no-browser",
        action="store_true",
        help="print the page's address without opening a browser",
    )
    parser.add_argument(
        "--port",
        type=_PORT,
        metavar="N",
        help="port of the page without --foxglove (default: 9090, or a free port)",
    )
    parser.add_argument(
        "--timeout",
        type=seconds,
        default=3.0,
        metavar="S",
        help="maximum age of the displayed picture when a command is sent, and maximum time to "
        "wait for the daemon's reply, in seconds (default 3)",
    )
    parser.add_argument(
        "--rate",
        type=number("0.1 to 100 Hz", 0.1, 100.0, includes_low=True),
        default=10.0,
        metavar="HZ",
        help="maximum number of pictures per second (default 10)",
    )


def _saved(text: str) -> Path:
    if not text.endswith((".html", ".svg")):
        raise argparse.ArgumentTypeError(f"expected a name ending in .html or .svg, found {text!r}")
    return Path(text)


def run(arguments: argparse.Namespace) -> int:
    """Show the page until a stop is requested. Raises SoftfingerError if nothing can be shown."""
    file, foxglove = arguments.file is not None, arguments.foxglove is not None
    if foxglove and file:
        raise SettingsError(
            "view: --foxglove: found FILE.mcap, but only the live stream can be served; open "
            "the file directly in Foxglove"
        )
    if foxglove and arguments.port is not None:
        raise SettingsError(
            "view: --port: found --foxglove, which serves the page and Foxglove on the same port; "
            "use --foxglove PORT without --port"
        )
    if arguments.save is not None and not file:
        raise SettingsError("view: --save requires a recording: add FILE.mcap")
    arguments.address, arguments.commands = arguments.address
    require("view")
    from softfinger.tools.viewing.page import show

    with StopCondition(arguments.duration, arguments.lifeline) as ending:
        show(arguments, ending)
    return 0
