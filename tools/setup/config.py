"""Run ``softfinger config``: check profiles, and show the package's profiles and all settings."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from softfinger.daemon.errors import SettingsError, SoftfingerError
from softfinger.daemon.profile import reference
from softfinger.daemon.profile.load import examine, find, names, profile_text
from softfinger.tools.arguments import add_profile, own_runtime_folder

_EPILOG = """\
  softfinger config check my.toml           print all errors and warnings; exit status 1 for errors
  softfinger config show hil > my.toml      create your own profile from a packaged profile
  softfinger config schema > schema.json    for completion and checks in editors (same folder)
  softfinger config reference tactile       print one section, or one key, e.g. pitch"""


_CHECK = """\
Print all errors and warnings for a profile, without accessing hardware. Errors prevent the start of
`softfinger run`: invalid keys or values, contradictions, and calibration files or contact tables
that do not match. Warnings concern settings that are valid but probably wrong, for example
a sensor that is smaller than the footprint, or forces that the servos can't reach.

exit status: 0 no errors (there may be warnings), 1 errors"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    check = actions.add_parser(
        "check",
        help="print all errors and warnings for a profile",
        description=_CHECK,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    check.add_argument("config", type=Path, metavar="FILE", help="a TOML file, or a profile name")
    add_profile(check, config=False)
    actions.add_parser("list", help="list the profile names")
    show = actions.add_parser("show", help="print a profile")
    show.add_argument("profile", type=Path, metavar="PROFILE", help=f"one of {', '.join(names())}")
    every = actions.add_parser(
        "reference", help="print every key with its default, bounds and meaning"
    )
    every.add_argument("what", nargs="?", default="", metavar="SECTION|KEY")
    actions.add_parser("schema", help="print the JSON schema of a profile, for editors")


def run(arguments: argparse.Namespace) -> int:
    """Check or print a profile, or print the list of profiles, the schema or the reference.

    Raises SettingsError for an unknown profile, section or key. Raises OSError if a file cannot be
    accessed.
    """
    if arguments.action == "check":
        return _check(arguments)
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


def _check(arguments: argparse.Namespace) -> int:
    """Print a profile's errors and warnings; return 1 if there are errors."""
    from softfinger.daemon.perception.finger_model import make_models

    name, errors, warnings = str(arguments.config), list[str](), list[str]()
    try:
        folder = arguments.dir or own_runtime_folder()
        settings, errors, warnings = examine(arguments.config, folder, arguments.set)
        if not errors:
            make_models(settings)
    except (SoftfingerError, ValueError) as error:
        errors += str(error).splitlines()
    for kind, lines in (("error", errors), ("warning", warnings)):
        for line in lines:
            print(f"{kind}: {line}")
    print(f"{name}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
    return 1 if errors else 0


def _count(lines: list[str], what: str) -> str:
    return f"{len(lines)} {what}{'' if len(lines) == 1 else 's'}"


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
        raise SettingsError(f"{what}: unknown section or key; see `softfinger config reference`")
    return "".join(f"{line}\n" for line in lines)
