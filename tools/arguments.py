"""Types of command-line arguments that several subcommands share."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.own_files import require_own, runtime_folder
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings

if TYPE_CHECKING:
    from softfinger.daemon.wire.keys import ClientKeys


def add_profile(parser: argparse.ArgumentParser) -> None:
    """``--config``, ``--set`` and ``--dir``: which hand. `profile` reads what they say."""
    add_settings(parser)
    parser.add_argument(
        "--dir",
        type=Path,
        metavar="DIR",
        help="what {dir} in the ports stands for; without it the folder of `softfinger emulate`",
    )


def add_settings(parser: argparse.ArgumentParser) -> None:
    """``--config`` and ``--set``, for a subcommand whose ``--dir`` is its own."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="PROFILE",
        help="settings: a TOML file, or a name as sim, demo, paper, small, hil",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting that goes over the file's, as loop.rate=1000; may be given again",
    )


def profile(arguments: argparse.Namespace) -> Settings:
    """The settings that `add_profile`'s arguments name. Raises SettingsError with the report."""
    return load(arguments.config, arguments.dir or own_runtime_folder(), arguments.set)


def own_runtime_folder() -> Path:
    """Where a stand-in hand links its ports without ``--dir``.

    Raises SettingsError when another user has made that folder.
    """
    folder = runtime_folder()
    try:
        require_own(folder)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise SettingsError(f"{folder}: {error.strerror}, or choose another by --dir") from None
    return folder


def add_keys(parser: argparse.ArgumentParser) -> None:
    """``--keys``, for a subcommand that speaks with a daemon that may want them: `client_keys`."""
    parser.add_argument(
        "--keys", type=Path, metavar="FOLDER", help="this client's keys, from `softfinger keys`"
    )


def client_keys(folder: Path | None) -> ClientKeys | None:
    """The keys that `add_keys` names, to guard a socket or a context with before it connects.

    Raises KeyFileError.
    """
    if folder is None:
        return None
    from softfinger.daemon.wire.keys import load_client

    return load_client(folder)


def stream_address(text: str) -> str:
    """The stream's address; when empty that of SOFTFINGER_ADDRESS, or else this machine's."""
    return text or _default_addresses()[0]


def command_address(text: str) -> str:
    """The commands' address, likewise."""
    return text or _default_addresses()[1]


def _default_addresses() -> tuple[str, str]:
    from softfinger.daemon.client.connection import default_addresses

    try:
        return default_addresses()
    except SettingsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def waiting(address: str, folder: Path | None) -> str:
    """What is told while nothing comes; a daemon that wants keys looks just so without them."""
    return f"waiting for a stream from {address}{_hint(folder)}"


def nothing(address: str, seconds: float, folder: Path | None) -> str:
    """And what, when no more is waited for."""
    return f"no stream from {address} within {seconds:g} s; is softfinger running?{_hint(folder)}"


def _hint(folder: Path | None) -> str:
    return " (with access.keys it needs --keys FOLDER)" if folder is None else ""


def teller(subcommand: str) -> Callable[[str], None]:
    """What tells a person a word beside the work."""
    return lambda said: print(f"{subcommand}: {said}", file=sys.stderr, flush=True)


def seconds(text: str) -> float:
    """A time above 0 s. Raises ArgumentTypeError with what was found."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"expected a time above 0 s, found {text!r}")
    return value


def moment(text: str) -> float:
    """A time of 0 s or more. Raises ArgumentTypeError with what was found."""
    return 0.0 if text.strip() in ("0", "0.0") else seconds(text)


def megabytes(text: str) -> float:
    """A size above 0 MB. Raises ArgumentTypeError with what was found."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"expected a size above 0 MB, found {text!r}")
    return value


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
