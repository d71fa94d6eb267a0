"""``softfinger install-service``: prints or writes a systemd unit and udev rules.

Nothing is enabled or started.
"""

from __future__ import annotations

import argparse
import pwd
import re
import sys
from pathlib import Path

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.own_files import write_text
from softfinger.daemon.profile.load import find

UNIT = "softfinger.service"
RULES = "70-softfinger.rules"
_EPILOG = """\
Without --to it only prints. To install:
  sudo softfinger install-service --config /etc/softfinger/hand.toml --user $USER \\
      --to /etc/systemd/system
  sudo softfinger install-service --udev --to /etc/udev/rules.d
  sudo systemctl daemon-reload && sudo systemctl enable --now softfinger
  sudo udevadm control --reload && sudo udevadm trigger
Exit status: 0 done, 1 not written."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("--config", type=Path, metavar="PROFILE", help="the hand's profile")
    parser.add_argument("--user", default="", help="the user it runs as (default: root)")
    parser.add_argument("--udev", action="store_true", help="the udev rules instead of the unit")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help=f"write {UNIT} or {RULES} there")
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")


def run(arguments: argparse.Namespace) -> int:
    """Print or write; 0, or 1 with the reason."""
    try:
        if arguments.udev:
            name, text = RULES, _file(RULES)
        else:
            name, text = UNIT, unit(arguments.config, arguments.user)
        if arguments.to is None:
            print(text, end="")
            return 0
        path = arguments.to / name
        with write_text(path) if arguments.force else path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        print(f"install-service: {path} exists already; --force overwrites it", file=sys.stderr)
        return 1
    except (OSError, ValueError, SettingsError) as error:
        print(f"install-service: {error}", file=sys.stderr)
        return 1
    print(path)
    return 0


def unit(config: Path | None, user: str) -> str:
    """Return the unit's text. Raises ValueError for a user or profile that is not there."""
    words = [sys.executable, "-P", "-m", "softfinger", "run", "--no-task", "--log", "json"]
    if config is not None:
        if not find(config).is_file():
            raise ValueError(f"{config}: no such profile")
        words += ["--config", str(find(config).resolve())]
    line = ""
    if user:
        try:
            pwd.getpwnam(user)
        except KeyError:
            raise ValueError(f"{user}: no such user") from None
        line = f"User={user}\n"
    command = " ".join(_quoted(word) for word in words)
    return _file(UNIT).format(command=command, user=line)


def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _quoted(word: str) -> str:
    """A word of ExecStart: nothing in it is a specifier, a variable or a separator."""
    if any(ord(character) < 32 for character in word):
        raise ValueError(f"{word!r}: control characters can't stand in a unit")
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{word}"' if re.search(r"[\s\"';\\]", word) else word
