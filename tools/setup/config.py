"""Run ``softfinger config``: show the packaged profiles and all settings."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile import reference
from softfinger.daemon.profile.load import find, names, profile_text

_EPILOG = """\
  softfinger config show hil > my.toml      start your own profile from a packaged one
  softfinger config schema > schema.json    in the same folder, for completion and checks in editors
  softfinger config reference tactile       print one section; or a key's name, e.g. pitch"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    actions.add_parser("list", help="list the names of the profiles")
    show = actions.add_parser("show", help="print a profile")
    show.add_argument("profile", type=Path, metavar="PROFILE", help=f"one of {', '.join(names())}")
    every = actions.add_parser("reference", help="every key with default, bounds and meaning")
    every.add_argument("what", nargs="?", default="", metavar="SECTION|KEY")
    actions.add_parser("schema", help="the JSON schema of a profile, for editors")


def run(arguments: argparse.Namespace) -> int:
    """Print the requested list, profile or reference.

    Raises SettingsError for an unknown profile, section or key. Raises OSError for a file error.
    """
    if arguments.action == "list":
        width = max(map(len, names()))
        for name in names():
            print(f"{name:{width}}  {subject(Path(name))}")
    elif arguments.action == "show":
        print(_text(arguments.profile), end="")
    elif arguments.action == "schema":
        print(reference.schema_text(), end="")
    else:
        print(_explained(arguments.what), end="")
    return 0


def _text(profile: Path) -> str:
    return profile_text(find(profile))


def subject(profile: Path) -> str:
    """Return the first sentence of a profile's opening comment."""
    comment = itertools.takewhile(lambda line: line.startswith("#"), _text(profile).splitlines())
    words = " ".join(line[1:].strip() for line in comment if not line.startswith("#:"))
    return min((words.partition(mark)[0] for mark in (": ", ". ")), key=len)


def _explained(what: str) -> str:
    """Return the reference text for a section, or for keys named ``section.key`` or ``key``."""
    if not what:
        return reference.profile()
    if what in reference.sections():
        return reference.section_text(what)
    lines = [
        line
        for key in reference.every_key()
        if what in (key.name, f"{key.section}.{key.name}")
        for line in key.lines(f"{key.section}.")
    ]
    if not lines:
        raise SettingsError(
            f"{what}: found no such section or key; see `softfinger config reference`"
        )
    return "".join(f"{line}\n" for line in lines)
