"""Run ``softfinger send COMMAND [key=value …]``: send one command and print the reply as JSON."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from typing import Any

from softfinger.daemon.client.command_client import UNCONFIRMED_TEXT, NoAnswer, send
from softfinger.daemon.client.connection import REPLY_TIMEOUT
from softfinger.daemon.control.modes import COMMANDS
from softfinger.daemon.errors import KeyFileError, SettingsError
from softfinger.tools.arguments import add_daemon, client_keys, seconds

_PAIR = re.compile(r"(\w+)=\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_ANGLES = {"rad": 1.0, "deg": math.radians(1.0), "°": math.radians(1.0)}
_UNITS = {  # accepted units for each key; numbers without a unit are in SI units
    "force": {"N": 1.0, "mN": 1e-3},
    **dict.fromkeys(("angle", "left", "right"), _ANGLES),
}
_EPILOG = """\
commands: arm, disarm, tare, grasp force=N, rotate angle=RAD, hold force=N angle=RAD (a streamed
setpoint), move left=RAD right=RAD, release, set compliance=RAD/NM, demo (restart the profile's
task), stop, clear, status. Numbers are in SI units or carry a unit: force=10N, angle=8deg or 8°.
Exit status: 0 done, 1 rejected, 2 no reply or invalid arguments, 3 stop or disarm was received, but
the servos have not yet confirmed that torque is off."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("command", metavar="COMMAND", choices=tuple(COMMANDS))
    parser.add_argument("values", metavar="key=value", nargs="*", default=[])
    add_daemon(parser, client=True)
    parser.add_argument(
        "--timeout",
        type=seconds,
        default=REPLY_TIMEOUT,
        metavar="S",
        help=f"seconds to wait for the reply (default {REPLY_TIMEOUT:g})",
    )


def run(arguments: argparse.Namespace) -> int:
    """Send the command and print the reply. Return 1 if the command was refused."""
    request: dict[str, Any] = {"command": arguments.command}
    if arguments.client:
        request["client"] = arguments.client
    request |= si_numbers(arguments.values)
    try:
        keys = client_keys(arguments.keys)
        reply = send(arguments.address[1], request, arguments.timeout, keys)
    except (NoAnswer, KeyFileError) as error:
        print(f"send: {error}", file=sys.stderr)
        return 2
    print(json_text(reply))
    if reply.get("torque_off") == "unconfirmed":
        print(f"send: {UNCONFIRMED_TEXT}", file=sys.stderr)
        return 3
    return 0 if reply.get("ok") else 1


def json_text(record: dict[str, Any]) -> str:
    """Format a map as JSON; NaN and infinity, which JSON cannot represent, become null."""

    def finite(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: finite(each) for name, each in value.items()}
        if isinstance(value, list | tuple):
            return [finite(each) for each in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(finite(record), ensure_ascii=False)


def si_numbers(words: list[str]) -> dict[str, float]:
    """Parse ``key=value`` words, and convert the values to SI units. Raises SettingsError."""
    numbers = {}
    for word in words:
        found = _PAIR.fullmatch(word)
        if found is None:
            raise SettingsError(f"send: found {word!r}, expected key=number")
        key, value, unit = found.groups()
        known = _UNITS.get(key, {})
        if unit and unit not in known:
            expected = " or ".join(known) or "a number without unit"
            raise SettingsError(f"send: {word}: found the unit {unit!r}, expected {expected}")
        numbers[key] = float(value) * known.get(unit, 1.0)
    return numbers
