"""Define command-line arguments that several subcommands share.

The settings module is imported only when a profile is loaded, because clients of a running hand do
not need settings.
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

WAIT_MAX = 5.0  # time limit for the first message with `--no-wait` [s]


def add_profile(
    parser: argparse.ArgumentParser, *, config: bool = True, folder: bool = True
) -> None:
    """Add ``--config``, ``--set`` and ``--dir``; `profile` loads the settings that they select.

    A subcommand can define its own argument ``config`` or ``dir`` instead.
    """
    if config:
        parser.add_argument(
            "--config",
            type=Path,
            metavar="PROFILE",
            help="settings: a TOML file, or a profile name listed by `softfinger config list`",
        )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a setting, e.g. loop.rate=1000; can be given several times",
    )
    if folder:
        parser.add_argument(
            "--dir",
            type=Path,
            metavar="DIR",
            help="replaces {dir} in port paths (default: the folder of `softfinger emulate`)",
        )


def profile(arguments: argparse.Namespace) -> Settings:
    """Load the settings selected with the `add_profile` arguments.

    Raises SettingsError, whose message lists all errors in the settings.
    """
    from softfinger.daemon.profile.load import load

    folder = arguments.dir or own_runtime_folder()
    try:
        return load(arguments.config, folder, arguments.set)
    except SettingsError as error:
        if folder is None and "{dir}" in str(error):
            raise SettingsError(f"{error}\n{runtime_fault()}") from None
        raise


def own_runtime_folder() -> Path | None:
    """Return the default folder for emulated ports, or None if there is no runtime folder."""
    return None if runtime_fault() else runtime_folder()


def client_keys(folder: Path | None) -> ClientKeys | None:
    """Load the client keys from the folder ``--keys``. Raises KeyFileError."""
    if folder is None:
        return None
    from softfinger.daemon.wire.keys import load_client

    return load_client(folder)


def addresses(text: str) -> tuple[str, str]:
    """Parse the stream and command addresses; a single socket address is used for both.

    An empty string selects SOFTFINGER_ADDRESS or, if the variable is unset, the default addresses
    on this machine. Raises ArgumentTypeError if an address is malformed, or its host is unknown.
    """
    from softfinger.daemon.client.connection import both_addresses, is_host, require_address

    try:
        is_one = text and "," not in text and not is_host(text)
        found = (text, text) if is_one else both_addresses(text)
        for address in found:
            require_address(address)
        return found
    except SettingsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def waiting(address: str, folder: Path | None) -> str:
    """Return the message that a waiting client prints; it includes a hint if keys are missing.

    A daemon that requires keys appears unreachable to a client without keys.
    """
    return f"waiting for a stream from {address}{_hint(folder)}"


def no_stream(address: str, folder: Path | None) -> str:
    """Return the error message for a stream that has not arrived in time."""
    return f"no stream from {address} within {WAIT_MAX:g} s; is softfinger running?{_hint(folder)}"


def _hint(folder: Path | None) -> str:
    return " (if access.keys is set, pass --keys FOLDER)" if folder is None else ""


def to_stderr(subcommand: str) -> Callable[[str], None]:
    """Return a function that prints the subcommand's name and a message to standard error."""
    return lambda line: print(f"{subcommand}: {line}", file=sys.stderr, flush=True)


def number(
    what: str,
    low: float,
    high: float = 1e9,
    *,
    includes_low: bool = False,
    kind: Callable[[float], float] = float,
) -> Callable[[str], Any]:
    """Return a parser for numbers within bounds, to be used as the ``type`` of an argument.

    The parser raises ArgumentTypeError with ``what``, the description of a valid number. ``kind``
    is int for whole numbers.
    """

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (low < value <= high or (includes_low and value == low)):
            raise argparse.ArgumentTypeError(f"expected {what}, found {text!r}")
        return kind(value)

    return parsed


seconds = number("a time above 0 s", 0.0)


def add_range(parser: argparse.ArgumentParser) -> None:
    """Add ``--from`` and ``--to``; ``start`` and ``end`` are in seconds after the first message."""
    whence = "seconds after the first message"
    parser.add_argument(
        "--from",
        type=number("a time of 0 s or more", 0.0, includes_low=True),
        default=-math.inf,
        metavar="S",
        dest="start",
        help=f"begin S {whence}",
    )
    parser.add_argument(
        "--to", type=seconds, default=math.inf, metavar="S", dest="end", help=f"end S {whence}"
    )


def range_text(arguments: argparse.Namespace) -> str:
    """Return the words that name the selected time range in a message, or "" without a range."""
    selected = math.isfinite(arguments.start) or math.isfinite(arguments.end)
    return " between --from and --to" if selected else ""


def add_daemon(parser: argparse.ArgumentParser, client: bool = False) -> None:
    """Add ``--address``, parsed by `addresses`, and ``--keys``; optionally add ``--client``."""
    parser.add_argument(
        "--address",
        type=addresses,
        default="",
        help="daemon address: tcp://HOST, a pair STREAM,COMMANDS, or the address of one socket",
    )
    parser.add_argument(
        "--keys",
        type=Path,
        metavar="FOLDER",
        help="folder with this client's keys, created by `softfinger keys`",
    )
    if client:
        parser.add_argument(
            "--client",
            type=_client,
            default="",
            help="client name, to which the lease is bound",
        )


def _client(text: str) -> str:
    """Parse a client name. Raises ArgumentTypeError for bytes that are not UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected UTF-8 text") from None
    return text


def add_stream(parser: argparse.ArgumentParser, client: bool = False) -> None:
    """Add a subscriber's arguments: ``--no-wait``, ``--duration`` and those of `add_daemon`."""
    add_daemon(parser, client)
    parser.add_argument(
        "--no-wait",
        action="store_true",
        help=f"exit with an error if nothing arrives for {WAIT_MAX:g} s; `monitor` also exits "
        "when the stream ends",
    )
    # The process exits when this pipe closes.
    parser.add_argument("--lifeline", type=int, help=argparse.SUPPRESS)
    add_duration(parser)


def add_duration(parser: argparse.ArgumentParser) -> None:
    """Add ``--duration``."""
    parser.add_argument("--duration", type=seconds, metavar="S", help="stop after S seconds")


def add_split(parser: argparse.ArgumentParser) -> None:
    """Add ``--split-size`` and ``--split-time``.

    A recorder's memory use grows with the file size, so splitting the file limits the memory use.
    """
    parser.add_argument(
        "--split-size",
        type=number("a size above 0 MB", 0.0),
        metavar="MB",
        help="start a new file when this size is reached",
    )
    parser.add_argument(
        "--split-time", type=seconds, metavar="S", help="start a new file after S seconds"
    )


ALL = b"all"


def topic(text: str) -> bytes:
    """Parse ``all`` or a topic name, with or without ``hand/``. Raises ArgumentTypeError."""
    from softfinger.daemon.wire import schema

    if text.encode() == ALL:
        return ALL
    name = (text if text.startswith("hand/") else f"hand/{text}").encode()
    if name not in schema.TOPICS:
        known = ", ".join(each.decode().removeprefix("hand/") for each in schema.TOPICS)
        raise argparse.ArgumentTypeError(f"found topic {text!r}, expected 'all' or one of {known}")
    return name
