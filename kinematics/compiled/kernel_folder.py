"""Manage the cache folders for compiled kernels, one per version of the sources and compiler.

The folder name is a digest of all sources that may affect a kernel. The digest also includes the
processor and the versions of Python, Numba, llvmlite and NumPy. Outdated kernels are therefore
never loaded. The program unpickles and executes the files, so it uses the folder only if no other
user can modify it. Each file begins with a digest of its content. If a file is corrupted, its
kernel is compiled again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import shutil
import sys
import time
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import llvmlite
import llvmlite.binding
import numba
import numpy as np

from softfinger.kinematics.compiled.own_folder import OwnFolder, user_cache

ROOT = Path(__file__).resolve().parents[2]  # directory of the `softfinger` package
_PACKAGES = ("kinematics", "daemon")
_FOLDER = re.compile(r"kernels-[0-9a-f]{16}")
# Number of other cache folders to keep, for example from other checkouts or the previous release.
_FOLDERS_MAX = 4
_RECENT = 600.0  # minimum age of a removed folder [s]; newer folders may be in use
_DECORATED = re.compile(rb"^@\w*kernel\b", re.MULTILINE)
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)|import[ \t]+([\w., \t]+))",
    re.MULTILINE,
)


_DIGEST = 32  # bytes
_KERNEL, _MARK = ".kernel", ".built"


@cache
def kernel_folder() -> OwnFolder | None:
    """Return the current cache folder (create it if needed); on failure, warn and return None."""
    try:
        return find_kernel_folder()
    except (OSError, RuntimeError) as error:
        warnings.warn(
            "compiled kernels can't be stored, so they will be recompiled at every start: "
            f"{error} (to use another folder, set NUMBA_CACHE_DIR)",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def find_kernel_folder() -> OwnFolder:
    """Return the current folder in NUMBA_CACHE_DIR or, by default, in the user's cache directory.

    Raises the exceptions of :class:`OwnFolder`, or RuntimeError if there is no home directory.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(given) if given else user_cache()
    if not given:
        OwnFolder(base).close()
    path = base / f"kernels-{digest()}"
    fresh = not path.exists()
    folder = OwnFolder(path)
    os.utime(folder.path)  # The new time marks the folder as used, so that it is not pruned.
    if fresh:
        with contextlib.suppress(FileNotFoundError):  # Another process may prune at the same time.
            _prune(base, path)
    return folder


def keep(folder: OwnFolder, name: str, content: bytes) -> None:
    """Store a kernel. On failure, issue a warning; the next start then recompiles the kernel."""
    try:
        folder.write(name + _KERNEL, hashlib.sha256(content).digest() + content)
    except OSError as error:
        warnings.warn(f"{folder.path}: a kernel can't be stored: {error}", RuntimeWarning, 2)


def kept(folder: OwnFolder, name: str) -> bytes | None:
    """Return a stored kernel, or None if it is missing or corrupted.

    A corrupted kernel causes a warning.
    """
    try:
        return _without_checksum(folder.read(name + _KERNEL))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        warnings.warn(
            f"{folder.path}: the kernel will be recompiled: {error}", RuntimeWarning, stacklevel=2
        )
        return None


def _without_checksum(data: bytes) -> bytes:
    content = data[_DIGEST:]
    if hashlib.sha256(content).digest() != data[:_DIGEST]:
        raise ValueError("stored kernels are corrupted")
    return content


def damaged(folder: OwnFolder) -> list[str]:
    """Return the names of corrupted or unreadable kernel files. Takes a few milliseconds."""
    found = []
    for name in folder.names():
        if name.endswith(_KERNEL):
            try:
                _without_checksum(folder.read(name))
            except (OSError, ValueError):
                found.append(name)
    return found


def remove_damaged(folder: OwnFolder) -> int:
    """Remove corrupted files and the marks of compiled parts; return the number of corrupted files.

    Raises OSError.
    """
    names = damaged(folder)
    for name in [*names, *(each for each in folder.names() if names and each.endswith(_MARK))]:
        folder.remove(name)
    return len(names)


def is_marked(folder: OwnFolder, part: str) -> bool:
    """Return True if the kernels of ``part`` are marked as compiled."""
    return part + _MARK in folder.names()


def mark(folder: OwnFolder, part: str) -> None:
    """Mark the kernels of ``part`` as compiled. On failure, the next start checks all kernels."""
    with contextlib.suppress(OSError):  # Another process may have pruned the folder.
        folder.write(part + _MARK, b"")


def _prune(base: Path, current: Path) -> None:
    """Remove other cache folders, except the newest ones and those used recently."""
    oldest = time.time() - _RECENT
    others = [
        each
        for each in base.iterdir()
        if _FOLDER.fullmatch(each.name) and each != current and not each.is_symlink()
    ]
    others.sort(key=lambda each: each.lstat().st_mtime, reverse=True)
    for old in others[_FOLDERS_MAX:]:
        if old.lstat().st_mtime < oldest:
            shutil.rmtree(old, ignore_errors=True)


@cache
def digest() -> str:
    """Return the digest in the folder name; the module docstring lists its inputs."""
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
    """Return all modules of this package that contain kernels, and the modules they import."""
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
    """Yield the modules of this package that ``source`` imports, including `from a import b`."""
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
    """Return the content of a source file; each file is read only once."""
    return path.read_bytes()
