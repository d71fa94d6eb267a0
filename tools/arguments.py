"""Command-line arguments that several subcommands share.

The settings are imported where a profile is taken: the clients of a running hand need none.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.own_files import runtime_fault, runtime_folder

if TYPE_CHECKING:
    from softfinger.daemon.profile.settings import Settings
    from softfinger.daemon.wire.keys import ClientKeys

PATIENCE = 5.0  # s that `--no-wait` gives a stream to arrive


def add_profile(parser: argparse.ArgumentParser) -> None:
    """``--config``, ``--set`` and ``--dir``: which hand. `profile` loads it."""
    add_settings(parser)
    parser.add_argument(
        "--dir",
        type=Path,
        metavar="DIR",
        help="replaces {dir} in the ports' paths (default: the folder of `softfinger emulate`)",
    )


def add_settings(parser: argparse.ArgumentParser) -> None:
    """``--config`` and ``--set``, for a subcommand whose ``--dir`` is its own."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="PROFILE",
        help="settings: a TOML file, or a name that `softfinger config list` has",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a setting, as loop.rate=1000; may be repeated",
    )


def profile(arguments: argparse.Namespace) -> Settings:
    """The settings that `add_profile`'s arguments name. Raises SettingsError with the report."""
    from softfinger.daemon.profile.load import load

    folder = arguments.dir or own_runtime_folder()
    try:
        return load(arguments.config, folder, arguments.set)
    except SettingsError as error:
        if folder is None and "{dir}" in str(error):
            raise SettingsError(f"{error}\n{runtime_fault()}") from None
        raise


def own_runtime_folder() -> Path | None:
    """Return where an emulated hand links its ports without ``--dir``; None: nowhere of our own."""
    return None if runtime_fault() else runtime_folder()


def client_keys(folder: Path | None) -> ClientKeys | None:
    """The keys that `add_daemon` names, to guard a socket or a context with before it connects.

    Raises KeyFileError.
    """
    if folder is None:
        return None
    from softfinger.daemon.wire.keys import load_client

    return load_client(folder)


def stream_address(text: str) -> str:
    """The stream's address: its own, or of ``tcp://HOST`` or ``STREAM,COMMANDS``.

    When empty that of SOFTFINGER_ADDRESS, or else this machine's. Raises ArgumentTypeError.
    """
    return addresses(text)[0]


def command_address(text: str) -> str:
    """The commands' address, as `stream_address`."""
    return addresses(text)[1]


def addresses(text: str) -> tuple[str, str]:
    """Return the stream's and the commands' address; one that stands alone is both."""
    from softfinger.daemon.client.connection import both_addresses, default_addresses, is_host

    try:
        if not text:
            return default_addresses()
        return both_addresses(text, "address") if "," in text or is_host(text) else (text, text)
    except SettingsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def waiting(address: str, folder: Path | None) -> str:
    """The line while no stream arrives; a daemon that requires keys looks the same without them."""
    return f"waiting for a stream from {address}{_hint(folder)}"


def no_stream(address: str, folder: Path | None) -> str:
    """The line when no stream arrived in time."""
    return f"no stream from {address} within {PATIENCE:g} s; is softfinger running?{_hint(folder)}"


def _hint(folder: Path | None) -> str:
    return " (with access.keys it needs --keys FOLDER)" if folder is None else ""


def to_stderr(subcommand: str) -> Callable[[str], None]:
    """A function that prints a line for people on standard error."""
    return lambda line: print(f"{subcommand}: {line}", file=sys.stderr, flush=True)


def number(
    text: str, what: str, low: float, high: float = 1e9, *, includes_low: bool = False
) -> float:
    """A number between bounds. Raises ArgumentTypeError with ``what`` was expected and found."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (low < value <= high or (includes_low and value == low)):
        raise argparse.ArgumentTypeError(f"expected {what}, found {text!r}")
    return value


def seconds(text: str) -> float:
    """A time above 0 s. Raises ArgumentTypeError."""
    return number(text, "a time above 0 s", 0.0)


def megabytes(text: str) -> float:
    """A size above 0 MB. Raises ArgumentTypeError."""
    return number(text, "a size above 0 MB", 0.0)


def add_range(parser: argparse.ArgumentParser) -> None:
    """``--from`` and ``--to``, in seconds from the first message on: ``start`` and ``end``."""

    def moment(text: str) -> float:
        return number(text, "a time of 0 s or more", 0.0, includes_low=True)

    whence = "seconds after the first message"
    parser.add_argument(
        "--from",
        type=moment,
        default=-math.inf,
        metavar="S",
        dest="start",
        help=f"begin S {whence}",
    )
    parser.add_argument(
        "--to", type=seconds, default=math.inf, metavar="S", dest="end", help=f"end S {whence}"
    )


def add_daemon(
    parser: argparse.ArgumentParser, kind: Callable[[str], Any], client: bool = False
) -> None:
    """``--address`` and ``--keys``, and ``--client`` of one that commands."""
    where = "where the daemon is: tcp://HOST, STREAM,COMMANDS, or one socket"
    parser.add_argument("--address", type=kind, default="", help=where)
    parser.add_argument(
        "--keys", type=Path, metavar="FOLDER", help="this client's keys, from `softfinger keys`"
    )
    if client:
        name = "a name: the commander's lease is bound to it"
        parser.add_argument("--client", default="", help=name)


def add_stream(
    parser: argparse.ArgumentParser,
    kind: Callable[[str], Any] = stream_address,
    client: bool = False,
) -> None:
    """`add_daemon`, ``--no-wait`` and ``--duration``, of a subscriber."""
    add_daemon(parser, kind, client)
    parser.add_argument(
        "--no-wait",
        action="store_true",
        help=f"end with an error when nothing arrives within {PATIENCE:g} s (monitor: or it ends)",
    )
    add_duration(parser)


def add_duration(parser: argparse.ArgumentParser) -> None:
    """``--duration``."""
    parser.add_argument("--duration", type=seconds, metavar="S", help="end after S seconds")


def add_split(parser: argparse.ArgumentParser) -> None:
    """``--split-size`` and ``--split-time``: a recorder's memory grows with its file."""
    parser.add_argument(
        "--split-size", type=megabytes, metavar="MB", help="begin a new file after this size"
    )
    parser.add_argument(
        "--split-time", type=seconds, metavar="S", help="begin a new file after S seconds"
    )


ALL = b"all"


def topic(text: str) -> bytes:
    """A topic of the stream by its name, with or without ``hand/``; or ``all``.

    Raises ArgumentTypeError with what was found.
    """
    from softfinger.daemon.wire import schema

    if text.encode() == ALL:
        return ALL
    name = (text if text.startswith("hand/") else f"hand/{text}").encode()
    if name not in schema.TOPICS:
        known = ", ".join(each.decode().removeprefix("hand/") for each in schema.TOPICS)
        raise argparse.ArgumentTypeError(f"found topic {text!r}, expected one of {known}, all")
    return name
