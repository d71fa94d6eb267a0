"""Folder of compiled kernels between runs: one for each state of sources and compiler.

The folder's name is a digest of every source that a kernel of this package may depend on, of
Python, Numba, llvmlite and NumPy, and of the processor, so nothing compiled from something else is
ever loaded. Numba unpickles what it finds there, and so runs it: the folder is the user's own, or
it is not used.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import stat
import sys
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import llvmlite
import llvmlite.binding
import numba
import numpy as np

ROOT = Path(__file__).resolve().parents[2]  # what `softfinger.` stands for in a name
_PACKAGES = ("kinematics", "daemon")
_FOLDER = re.compile(r"kernels-[0-9a-f]{16}")
_FOLDERS_MAX = (
    4  # folders of other sources or compilers that stay: other checkouts, the last release
)
_DECORATED = re.compile(rb"^@\w*kernel\b", re.MULTILINE)
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)|import[ \t]+([\w., \t]+))",
    re.MULTILINE,
)


@cache
def kernel_folder() -> Path | None:
    """Return this state's folder, made when absent; warn and return None if that fails."""
    try:
        return find_folder()
    except (OSError, RuntimeError) as error:
        warnings.warn(
            f"compiled kernels can't be kept, so every start compiles anew: {error} "
            "(NUMBA_CACHE_DIR names another folder)",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def find_folder() -> Path:
    """Return this state's folder in NUMBA_CACHE_DIR if set, else in the user's cache directory.

    Raises as :func:`own_folder`, and RuntimeError where there is no home.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(given) if given else user_cache()
    if not given:
        own_folder(base)
    folder = base / f"kernels-{digest()}"
    fresh = not folder.exists()
    own_folder(folder)
    os.utime(folder)  # by which pruning knows what is in use
    if fresh:
        _prune(base, folder)
    return folder


def user_cache() -> Path:
    """Return this program's cache directory of the user. Raises RuntimeError without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "softfinger" if base else Path.home() / ".cache" / "softfinger"


def own_folder(folder: Path) -> None:
    """Make ``folder`` for this user alone (0700) if absent; else see that it is no one else's.

    Raises PermissionError where another user owns it or may write to it, NotADirectoryError where
    it is something else, OSError where it can't be made or written.
    """
    if not folder.is_symlink() and not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{folder}: found a link or a file, expected a folder")
    if found.st_uid != os.geteuid():
        raise PermissionError(
            f"{folder}: belongs to user {found.st_uid}, expected {os.geteuid()}, who runs this"
        )
    if found.st_mode & 0o022:
        raise PermissionError(
            f"{folder}: others may write to it (mode {found.st_mode & 0o777:o}); chmod 700 {folder}"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder}: may not be written to")


def _prune(base: Path, current: Path) -> None:
    """Remove all but the last used of the other folders that were made here."""
    others = [
        each
        for each in base.iterdir()
        if _FOLDER.fullmatch(each.name) and each != current and not each.is_symlink()
    ]
    others.sort(key=lambda each: each.lstat().st_mtime, reverse=True)
    for old in others[_FOLDERS_MAX:]:
        shutil.rmtree(old, ignore_errors=True)


@cache
def digest() -> str:
    """Return a name for this state of sources, Python, Numba, llvmlite, NumPy and processor."""
    state = hashlib.sha256()
    packages = (numba.__version__, llvmlite.__version__, np.__version__)
    versions = (sys.version, *packages, platform.machine())
    cpu = os.environ.get("NUMBA_CPU_NAME") or llvmlite.binding.get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES")
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    state.update(repr((versions, cpu, features)).encode())
    for source in kernel_sources():
        state.update(f"{source.relative_to(ROOT)}\n".encode())
        state.update(hashlib.sha256(text(source)).digest())
    return state.hexdigest()[:16]


@cache
def kernel_sources() -> tuple[Path, ...]:
    """Return every module of ours with a kernel in it, and all that these import."""
    files = (each for name in _PACKAGES for each in (ROOT / name).rglob("*.py"))
    waiting = [file for file in files if _DECORATED.search(text(file))]
    seen: set[Path] = set()
    while waiting:
        source = waiting.pop()
        if source not in seen:
            seen.add(source)
            waiting.extend(_imported(source))
    return tuple(sorted(seen))


def _imported(source: Path) -> Iterator[Path]:
    """Modules of ours that ``source`` names: `import a.b`, `from a import b`, b a module or not."""
    for module, names, modules in _IMPORT.findall(text(source)):
        found = [each.split()[0] for each in modules.split(b",")] if modules else [module]
        parts = [name.split()[0] for name in names.strip(b"()").split(b",") if name.split()]
        found += [module + b"." + part for part in parts]
        for name in found:
            yield from _files(name.decode())


@cache
def _files(name: str) -> tuple[Path, ...]:
    top, *parts = name.split(".")
    if top != "softfinger" or not parts or parts[0] not in _PACKAGES:
        return ()
    place = ROOT.joinpath(*parts)
    either = place.with_suffix(".py"), place / "__init__.py"
    return tuple(each for each in either if each.is_file())


@cache
def text(path: Path) -> bytes:
    """Return a file's source, read once."""
    return path.read_bytes()
