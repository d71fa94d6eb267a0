"""Parse the command line and run the selected subcommand.

Each subcommand is a module in a ``tools/`` package and is imported only when called. The module
defines ``add_arguments(parser)`` and ``run(arguments) -> exit status``. For invalid settings or
contradictory arguments, the module raises SettingsError (exit status 2). For other errors that the
user can correct, the module raises another SoftfingerError or an OSError (exit status 1).
"""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import os
import re
import signal
import sys
from collections.abc import Collection, Sequence
from typing import Any, NoReturn

from softfinger import __version__
from softfinger.daemon.errors import SettingsError, SoftfingerError, nearest

_FULL = (errno.ENOSPC, errno.EFBIG)  # The disk is full, or the file has its maximum size.
_OPTIONS = ("-h", "--help", "--version")
_UNKNOWN = re.compile(r"invalid choice: '([^']*)'|unrecognized arguments: (\S+)")

GROUPS = {  # maps each subcommand to its package in tools/ and its description
    "run": {
        "run": ("processes", "run the daemon; without --config, for the built-in simulated hand"),
        "emulate": ("processes", "emulate a hand: servos and tactile boards on ptys"),
    },
    "hand": {
        "status": ("terminal", "show the state of the running hand in one line"),
        "send": ("terminal", "send one command to the running daemon"),
        "monitor": ("terminal", "show and command the running hand in the terminal"),
        "view": ("viewing", "show and command the running hand on a web page, or show a recording"),
    },
    "data": {
        "record": ("recordings", "record the running daemon's stream in an MCAP file"),
        "replay": ("recordings", "publish a recording again, or recompute it with this version"),
        "analyse": ("recordings", "compute contact, force and energy over time from frames"),
        "plot": (
            "recordings",
            "plot a recording together with the model: forces, energy landscape, errors",
        ),
        "export": ("recordings", "export a recording's topics as CSV or Parquet"),
    },
    "machine": {
        "doctor": ("setup", "check ports, servos, boards and this machine, and suggest fixes"),
        "scan": ("setup", "find the servos on a port, at any baud rate"),
        "calibrate": ("calibration", "calibrate joints, sensors and tips, step by step"),
        "envelope": (
            "setup",
            "simulate which shapes, sizes, friction coefficients and masses a hand holds",
        ),
        "limits": ("setup", "list every limit: condition, consequence, setting"),
        "config": ("setup", "list and show the profiles, and every setting with its default"),
        "compile": ("processes", "compile a hand's kernels before its first start"),
        "keys": ("setup", "create the keys required for access from other machines"),
        "install-service": ("setup", "print a systemd unit and udev rules"),
        "completion": ("setup", "print a completion script for bash, zsh or fish"),
    },
    "develop": {
        "figures": ("paper", "compute the paper's figures with this model, as CSV and PNG"),
        "validate": ("paper", "compare this model with published results"),
        "bench": ("benchmarks", "measure run times and the simulated hand's behaviour"),
    },
}
SUBCOMMANDS = {name: row for rows in GROUPS.values() for name, row in rows.items()}

_LINUX = (*GROUPS["run"], "doctor", "scan", "calibrate", "compile", "install-service", "bench")
_FIRST_STEPS = """\
softfinger {version}: two rotational fingers with soft tips. To start:
  softfinger run --monitor          run a simulated hand with its live page; q ends both
  softfinger send arm               in another terminal: switch torque on; then send grasp force=10
  softfinger run --config PROFILE   run another hand; softfinger config list prints the profiles
  softfinger doctor --config FILE   check a physical hand and list the missing steps
  softfinger help                   list all subcommands; help SUBCOMMAND lists its arguments"""
_EPILOG = """\
Arguments of a subcommand: softfinger help SUBCOMMAND. To start: softfinger run --monitor
Exit status: 0 success; 1 failure (the reason is printed); 2 invalid arguments or settings; 130
interrupted by Ctrl-C. The help of a subcommand lists its additional exit statuses."""


def _open_standard_streams() -> None:
    """Open /dev/null for closed standard streams, so that no other file gets descriptors 0 to 2.

    Also replace characters that a terminal or pipe cannot encode, such as θ.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(descriptor, True)  # Child processes inherit the descriptor.
            setattr(sys, name, os.fdopen(descriptor, mode))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


class Parser(argparse.ArgumentParser):
    """Argument parser that suggests the closest known word for an unknown word."""

    def error(self, message: str) -> NoReturn:
        unknown = _UNKNOWN.search(message)
        if unknown is not None:
            known = [word for action in self._actions for word in action.option_strings]
            known += [word for action in self._actions for word in action.choices or ()]
            word = next(filter(None, unknown.groups()))
            if near := nearest(word.partition("=")[0], known):
                message = f"unknown word {word!r}{near}"
        super().error(message)


class TopParser(Parser):
    """Argument parser whose help lists the subcommands in groups."""

    def format_help(self) -> str:
        lines = [f"usage: {self.prog} SUBCOMMAND …\n\n{self.description}"]
        for group, rows in GROUPS.items():
            lines.append(f"\n{group}:")
            lines += [f"    {name:17}{text}" for name, (_, text) in rows.items()]
        return "\n".join([*lines, f"\n{self.epilog}\n"])


def make_parser(imported: Collection[str]) -> tuple[Parser, dict[str, tuple[Any, Parser]]]:
    """Make a parser for all subcommands.

    Returns
    -------
    The parser, and the module and parser of each subcommand in ``imported``. Parsers for all other
    subcommands have no arguments.
    """
    parser = TopParser(
        prog="softfinger",
        description="Two rotational fingers with soft tips: daemon and tools.",
        epilog=_EPILOG,
    )
    parser.add_argument("--version", action="version", version=f"softfinger {__version__}")
    subparsers = parser.add_subparsers(
        dest="subcommand", metavar="SUBCOMMAND", required=True, parser_class=Parser
    )
    made = {}
    for name, (package, text) in SUBCOMMANDS.items():
        subparser = subparsers.add_parser(
            name,
            help=text,
            description=text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in imported:
            module = importlib.import_module(f"softfinger.tools.{package}.{name.replace('-', '_')}")
            module.add_arguments(subparser)
            made[name] = module, subparser
    return parser, made


# Parts of the messages that the shared-library loader prints when memory is exhausted.
_NO_MEMORY = ("failed to map segment", "Cannot allocate memory", "libllvmlite")


def _lacks_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or any(text in str(error) for text in _NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``softfinger``; return the exit status."""
    try:
        return _main(argv)
    except (MemoryError, ImportError, OSError) as error:
        if not _lacks_memory(error):
            raise
        print(
            "softfinger: not enough memory for this process, which requires about 1 GB of "
            "address space: raise `ulimit -v`, or close other programs",
            file=sys.stderr,
        )
        return 1


def _main(argv: Sequence[str] | None) -> int:
    # Until the subcommand installs its own handler, Ctrl-C exits the process without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _open_standard_streams()
    words = list(sys.argv[1:] if argv is None else argv)
    if not words:
        print(_FIRST_STEPS.format(version=__version__))
        return 0
    if words[:1] == ["help"]:
        words = [*words[1:2], "--help"]
    # Import only the subcommand that was called.
    called = next((word for word in words if word in SUBCOMMANDS), "")
    if called in _LINUX and sys.platform != "linux":
        print(
            f"{called}: found {sys.platform}, expected Linux: the daemon requires the Linux "
            "scheduler and serial ports; the client, gym, recordings and `softfinger view` work "
            "on this platform",
            file=sys.stderr,
        )
        return 1
    try:
        parser, made = make_parser([called])
    except SoftfingerError as error:
        print(f"{called}: {error}", file=sys.stderr)
        return 1
    if not called and words[0] not in _OPTIONS:
        near = nearest(words[0], [*SUBCOMMANDS, *_OPTIONS])
        hint = near or "; run `softfinger help` to list them"
        parser.error(f"found {words[0]!r}, expected a subcommand{hint}")
    arguments, unknown = parser.parse_known_args(words)
    module, subparser = made[called]
    if unknown:
        subparser.error(f"unrecognized arguments: {' '.join(unknown)}")
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        status: int = module.run(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130  # exit status for Ctrl-C by shell convention
    except BrokenPipeError:
        # The reader has closed the pipe, as with `| head`. Discard the remaining output.
        _discard_output()
        return 0
    except SettingsError as error:  # The error message has one line per key.
        print(error, file=sys.stderr)
        return 2
    except SoftfingerError as error:
        print(f"{called}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        if error.filename is None and error.errno not in _FULL:
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"{called}: {where}{error.strerror}", file=sys.stderr)
        try:
            sys.stdout.flush()
        except OSError:
            _discard_output()
        return 1
    return status


def _discard_output() -> None:
    """Redirect standard output to /dev/null, so that Python's flush at exit can't fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
