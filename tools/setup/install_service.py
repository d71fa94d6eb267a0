"""Run ``softfinger install-service``: print a systemd unit or udev rules, without enabling them."""

from __future__ import annotations

import argparse
import pwd
import re
import sys
from pathlib import Path

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.port_access import serial_group
from softfinger.daemon.profile.load import find

_EPILOG = """\
To install the printed files:
  softfinger install-service --config /etc/softfinger/hand.toml --user $USER |
      sudo tee /etc/systemd/system/softfinger.service
  softfinger install-service --udev | sudo tee /etc/udev/rules.d/70-softfinger.rules
  sudo systemctl daemon-reload && sudo systemctl enable --now softfinger
  sudo udevadm control --reload && sudo udevadm trigger"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("--config", type=Path, metavar="PROFILE", help="the hand's profile")
    parser.add_argument("--user", default="", help="user that runs the service (default: root)")
    parser.add_argument("--udev", action="store_true", help="print udev rules instead of the unit")


def run(arguments: argparse.Namespace) -> int:
    """Print the unit or the rules. Raises SettingsError if the user or profile does not exist."""
    rules = _file("70-softfinger.rules").replace("dialout", serial_group())
    print(rules if arguments.udev else unit(arguments.config, arguments.user), end="")
    return 0


def unit(config: Path | None, user: str) -> str:
    """Return the unit's text. Raises SettingsError if the user or profile does not exist."""
    words = [sys.executable, "-P", "-m", "softfinger", "run", "--no-task", "--log", "json"]
    if config is not None:
        if not find(config).is_file():
            raise SettingsError(f"install-service: {config}: profile not found")
        words += ["--config", str(find(config).resolve())]
    line = ""
    if user:
        try:
            pwd.getpwnam(user)
        except KeyError:
            raise SettingsError(f"install-service: {user}: user not found") from None
        line = f"User={user}\n"
    command = " ".join(_quoted(word) for word in words)
    return _file("softfinger.service").format(command=command, user=line, group=serial_group())


def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _quoted(word: str) -> str:
    """Quote one word for ExecStart, and escape specifiers, variables and separators."""
    if any(ord(character) < 32 for character in word):
        raise SettingsError(f"{word!r}: a systemd unit can't contain control characters")
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{word}"' if re.search(r"[\s\"';\\]", word) else word
