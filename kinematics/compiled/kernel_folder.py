"""Folder of compiled kernels between runs: one for each state of sources and compiler.

The folder's name is a digest of every source that a kernel of this package may depend on, of
Python, Numba, llvmlite and NumPy, and of the processor, so nothing compiled from something else is
ever loaded. What is found there is unpickled and run: the folder is the user's own, or it is not
used. Each kernel's file begins with a digest of the rest: a file that is torn or has rotted is
compiled anew.
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

ROOT = Path(__file__).resolve().parents[2]  # what `softfinger.` stands for in a name
_PACKAGES = ("kinematics", "daemon")
_FOLDER = re.compile(r"kernels-[0-9a-f]{16}")
_FOLDERS_MAX = 4  # folders of other sources or compilers that stay: other checkouts, a release
_RECENT = 600.0  # s; a folder used since then stays too, because its program may still run
_DECORATED = re.compile(rb"^@\w*kernel\b", re.MULTILINE)
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)|import[ \t]+([\w., \t]+))",
    re.MULTILINE,
)


_DIGEST = 32  # bytes
_KERNEL, _MARK = ".kernel", ".built"


@cache
def kernel_folder() -> OwnFolder | None:
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


def find_folder() -> OwnFolder:
    """Return this state's folder in NUMBA_CACHE_DIR if set, else in the user's cache directory.

    Raises as :class:`OwnFolder`, and RuntimeError where there is no home.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(given) if given else user_cache()
    if not given:
        OwnFolder(base).close()
    path = base / f"kernels-{digest()}"
    fresh = not path.exists()
    folder = OwnFolder(path)
    os.utime(folder.path)  # by which pruning knows what is in use
    if fresh:
        _prune(base, path)
    return folder


def keep(folder: OwnFolder, name: str, content: bytes) -> None:
    """Keep a kernel; where that fails, warn: it is compiled anew at the next start."""
    try:
        folder.write(name + _KERNEL, hashlib.sha256(content).digest() + content)
    except OSError as error:
        warnings.warn(f"{folder.path}: a kernel can't be kept: {error}", RuntimeWarning, 2)


def kept(folder: OwnFolder, name: str) -> bytes | None:
    """Return a kernel that was kept, None where there is none or, with a warning, no sound one."""
    try:
        return _sound(folder.read(name + _KERNEL))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        warnings.warn(f"{folder.path}: compiled anew: {error}", RuntimeWarning, stacklevel=2)
        return None


def _sound(data: bytes) -> bytes:
    content = data[_DIGEST:]
    if hashlib.sha256(content).digest() != data[:_DIGEST]:
        raise ValueError("kernels are damaged")
    return content


def damaged(folder: OwnFolder) -> list[str]:
    """Return the names of files that hold no sound kernel, or can't be read: some ms for all."""
    found = []
    for name in folder.names():
        if name.endswith(_KERNEL):
            try:
                _sound(folder.read(name))
            except (OSError, ValueError):
                found.append(name)
    return found


def remove_damaged(folder: OwnFolder) -> int:
    """Remove such files, and what says which parts are built; their number. Raises OSError."""
    names = damaged(folder)
    for name in [*names, *(each for each in folder.names() if names and each.endswith(_MARK))]:
        folder.remove(name)
    return len(names)


def is_marked(folder: OwnFolder, part: str) -> bool:
    """Return whether the kernels of ``part`` were marked as compiled."""
    return part + _MARK in folder.names()


def mark(folder: OwnFolder, part: str) -> None:
    """Mark the kernels of ``part`` as compiled; where that fails they are looked for anew."""
    with contextlib.suppress(OSError):  # another process may have pruned the folder meanwhile
        folder.write(part + _MARK, b"")


def _prune(base: Path, current: Path) -> None:
    """Remove the other folders that were made here, except recent ones and the last used."""
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
