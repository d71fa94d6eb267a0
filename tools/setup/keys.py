"""Run ``softfinger keys FOLDER [CLIENT …]``: create keys for access from other machines."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.daemon.wire.keys import make_keys

_EPILOG = """\
The first call creates the daemon's keys and the keys of the client `local`, for tools on the
daemon's machine. Each CLIENT adds the keys of one client. Set access.keys in the profile to FOLDER,
copy FOLDER/CLIENT to the client's machine, and pass this copy to the tools with --keys. Files are
never overwritten. If you remove FOLDER/server/clients/CLIENT.key, the client is disconnected within
a second. If keys are used, the lease is bound to the client's key name.
Exit status: 0 keys created, 1 an error occurred."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("clients", nargs="*", default=[], metavar="CLIENT")


def run(arguments: argparse.Namespace) -> int:
    """Create the keys. Raises KeyFileError."""
    for folder in make_keys(arguments.folder, arguments.clients):
        print(folder)
    return 0
