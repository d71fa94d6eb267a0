"""Prepare a release: set the version, date the changelog, and build and check the packages.

`make release VERSION=X.Y.Z` runs ``prepare``, then lint, tests and documentation, then ``build``.
Both steps may be repeated. The maintainer then commits, tags and uploads the release.
"""

from __future__ import annotations

import argparse
import datetime
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CHANGELOG = "CHANGELOG.md"
# File, quantity and pattern of each line that states the version, date or year of the release.
RELEASE_LINES = (
    ("softfinger/__init__.py", "version", r'(?m)^(__version__ = ")(.*)(")$'),
    ("lerobot_robot_softfinger/pyproject.toml", "version", r'(?m)^(version = ")(.*)(")$'),
    ("CITATION.cff", "version", r"(?m)^(version: )(.*)()$"),
    ("CITATION.cff", "date", r"(?m)^(date-released: )(.*)()$"),
    ("README.md", "version", r"(?m)^(  version = \{)(.*)(\},)$"),
    ("README.md", "year", r"(?m)^(  year = \{)(.*)(\},)$"),
)
MAX_LINES = 40  # maximum number of changelog lines per release, not counting blank lines
_UNRELEASED = "## [Unreleased]\n"


class ReleaseError(Exception):
    """Error raised if the release cannot be prepared."""


def sections(changelog: str) -> dict[str, str]:
    """Map each changelog version, and ``Unreleased``, to the text below its heading."""
    parts = re.split(r"(?m)^## \[(.+?)\].*\n", changelog)
    return dict(zip(parts[1::2], (text.strip() for text in parts[2::2]), strict=True))


def stated(changelog: str, version: str) -> dict[str, str]:
    """Return the version, date and year that the release lines contain."""
    (date,) = re.findall(rf"(?m)^## \[{re.escape(version)}\] - (\S+)$", changelog)
    return {"version": version, "date": date, "year": date[:4]}


def dated(changelog: str, version: str, today: datetime.date) -> str:
    """Move the unreleased entries to a heading for ``version``.

    The changelog is not changed if it already has this version and no unreleased entries.

    Raises
    ------
    ReleaseError
        If the version has no entries, is not newer than the last release, or has too many lines.
    """
    found = sections(changelog)
    unreleased = found.pop("Unreleased", None)
    if unreleased is None:
        raise ReleaseError(f"{CHANGELOG}: found no heading {_UNRELEASED.strip()!r}; add it")
    if unreleased and version in found:
        raise ReleaseError(
            f"{CHANGELOG}: found entries below both Unreleased and {version}; fold them into one"
        )
    if not unreleased and version not in found:
        raise ReleaseError(f"{CHANGELOG}: found no entries for {version} below Unreleased")
    older = [each for each in found if each != version]
    if older and _parts(version) <= max(map(_parts, older)):
        newest = max(older, key=_parts)
        raise ReleaseError(f"VERSION: found {version}, expected one above {newest}")
    text = found.get(version, unreleased)
    count = 1 + sum(bool(line.strip()) for line in text.splitlines())
    if count > MAX_LINES:
        raise ReleaseError(
            f"{CHANGELOG}: found {count} lines for {version}, expected at most {MAX_LINES}; "
            "keep what users notice"
        )
    if not unreleased:
        return changelog
    return changelog.replace(_UNRELEASED, f"{_UNRELEASED}\n## [{version}] - {today}\n", 1)


def _parts(version: str) -> tuple[int, ...]:
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise ReleaseError(f"VERSION: found {version!r}, expected three numbers, as 1.4.0")
    return tuple(map(int, version.split(".")))


def prepare(version: str) -> None:
    """Write the version and the changelog date to the project files."""
    _parts(version)
    ours = {CHANGELOG, *(name for name, _, _ in RELEASE_LINES)}
    changed = {line[3:] for line in _git("status", "--porcelain").splitlines()}
    if others := sorted(changed - ours):
        raise ReleaseError(f"found uncommitted files, commit or stash them: {', '.join(others)}")
    if _git("tag", "--list", f"v{version}"):
        raise ReleaseError(f"VERSION: found the tag v{version}, expected a version without one")
    log = ROOT / CHANGELOG
    changelog = dated(log.read_text("utf-8"), version, datetime.date.today())
    log.write_text(changelog, "utf-8")
    values = stated(changelog, version)
    for name, quantity, pattern in RELEASE_LINES:
        text = (ROOT / name).read_text("utf-8")
        text = re.sub(pattern, rf"\g<1>{values[quantity]}\g<3>", text)
        (ROOT / name).write_text(text, "utf-8")


def build(version: str) -> None:
    """Build sdist and wheel in ``dist/``, check them, and print the commands for publishing."""
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    _run(sys.executable, "-m", "build", "--outdir", dist)
    built = sorted(dist.iterdir())
    _run(sys.executable, "-m", "twine", "check", "--strict", *built)
    environment = ROOT / "build" / "release"
    venv.create(environment, clear=True, with_pip=True)
    wheel = next(path for path in built if path.suffix == ".whl")
    python = environment / "bin" / "python"
    constraints = ("--constraint", ROOT / "constraints.txt")
    _run(python, "-m", "pip", "install", "--quiet", *constraints, wheel)
    command = [environment / "bin" / "softfinger", "--version"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    if told != f"softfinger {version}":
        raise ReleaseError(f"{wheel.name}: --version prints {told!r}, expected {version}")
    print(f"{wheel.name}: prints {told!r}")
    print("To release, type:")
    if _git("status", "--porcelain"):
        print(f"  git commit --all --message 'release: {version}'")
    print(f"  git tag --annotate v{version} --message 'softfinger {version}'")
    print(f"  git push origin HEAD v{version}")
    print(f"  {sys.executable} -m twine upload dist/*")


def _git(*words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=ROOT, check=True, capture_output=True, text=True, encoding="utf-8"
    )
    return done.stdout


def _run(*words: str | Path) -> None:
    subprocess.run(words, cwd=ROOT, check=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("step", choices=("prepare", "build"))
    parser.add_argument("version", metavar="X.Y.Z")
    arguments = parser.parse_args()
    try:
        {"prepare": prepare, "build": build}[arguments.step](arguments.version)
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"release: {error.cmd[0]} ended with status {error.returncode}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
