"""``softfinger config``: the profiles that come with the package, and every setting there is."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.load import find, names, profile_text

_REFERENCE = Path("sim")  # it has every key, with default, unit and meaning
_EPILOG = """\
  softfinger config show hil > my.toml      the beginning of a profile of your own
  softfinger config reference tactile       that section alone; or a key's name, as pitch"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    actions.add_parser("list", help="the profiles' names")
    show = actions.add_parser("show", help="print a profile")
    show.add_argument("profile", type=Path, metavar="PROFILE", help=f"one of {', '.join(names())}")
    reference = actions.add_parser("reference", help="every key, with default, unit and meaning")
    reference.add_argument("what", nargs="?", default="", metavar="SECTION|KEY")


def run(arguments: argparse.Namespace) -> int:
    """Print. Raises SettingsError for a profile, section or key that is not there, or OSError."""
    if arguments.action == "list":
        width = max(map(len, names()))
        for name in names():
            print(f"{name:{width}}  {subject(Path(name))}")
    elif arguments.action == "show":
        print(_text(arguments.profile), end="")
    else:
        print(_part(_text(_REFERENCE), arguments.what), end="")
    return 0


def _text(profile: Path) -> str:
    return profile_text(find(profile))


def subject(profile: Path) -> str:
    """Return the comment that a profile begins with, up to its first stop."""
    comment = re.match(r"(#.*\n)+", _text(profile))
    words = "" if comment is None else comment[0].replace("#", " ")
    return re.split(r"[:.] ", " ".join(words.split()))[0]


def _part(text: str, what: str) -> str:
    """The section called ``what``, or the lines of a key, as ``section.key`` or alone."""
    if not what:
        return text
    section, _, key = what.rpartition(".")
    lines = []
    for part in re.split(r"\n(?=\[)", text)[1:]:
        title, *rest = part.splitlines()
        if title == f"[{what}]":
            return f"{part.rstrip()}\n"
        if section in ("", title[1:-1]):
            lines += [f"{title[1:-1]}.{line}" for line in rest if line.split(" = ")[0] == key]
    if not lines:
        raise SettingsError(
            f"{what}: found no such section or key; see `softfinger config reference`"
        )
    return "".join(f"{line}\n" for line in lines)
