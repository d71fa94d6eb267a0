"""``softfinger send COMMAND [key=value …]``: one command to the daemon, its reply as JSON."""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

from softfinger.daemon.client.command_client import UNCONFIRMED, NoAnswer, send
from softfinger.daemon.client.connection import PATIENCE
from softfinger.daemon.errors import KeyFileError
from softfinger.tools.arguments import add_keys, client_keys, command_address, seconds

_EPILOG = """\
commands: arm, disarm, tare, grasp force=N, rotate angle=RAD, move left=RAD right=RAD, release,
set compliance=RAD/NM, stop, clear, status. Numbers are SI; an angle may carry its unit, as in
angle=10deg.
Exit status: 0 done, 1 refused, 2 no answer or not understood here, 3 stop or disarm was received,
but the servos have not confirmed torque off yet."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("command", metavar="COMMAND")
    parser.add_argument("values", metavar="key=value", nargs="*")
    parser.add_argument("--address", type=command_address, default="", help="command socket")
    add_keys(parser)
    parser.add_argument("--client", default="", help="a name: the commander's lease is bound to it")
    parser.add_argument(
        "--timeout",
        type=seconds,
        default=PATIENCE,
        metavar="S",
        help=f"seconds to wait for the reply (default {PATIENCE:g})",
    )


def run(arguments: argparse.Namespace) -> int:
    """Send, print the reply, exit status by whether it was carried out."""
    request: dict[str, Any] = {"command": arguments.command}
    if arguments.client:
        request["client"] = arguments.client
    for word in arguments.values:
        key, separator, text = word.partition("=")
        value = _value(text)
        if not separator or value is None:
            print(f"send: found {word!r}, expected key=number", file=sys.stderr)
            return 2
        request[key] = value
    try:
        reply = send(arguments.address, request, arguments.timeout, client_keys(arguments.keys))
    except (NoAnswer, KeyFileError) as error:
        print(f"send: {error}", file=sys.stderr)
        return 2
    print(json.dumps(reply, ensure_ascii=False))
    if reply.get("torque_off") == "unconfirmed":
        print(f"send: {UNCONFIRMED}", file=sys.stderr)
        return 3
    return 0 if reply.get("ok") else 1


def _value(text: str) -> float | None:
    """A number, or an angle in degrees as radians; None for what is neither."""
    try:
        number = float(text.removesuffix("deg"))
    except ValueError:
        return None
    return math.radians(number) if text.endswith("deg") else number
