"""Read user-specified files within size limits, and write files safely in shared folders.

A path from a user or from another file may refer to a device, a pipe without a writer, or a file
that does not fit in memory. In a shared folder such as /tmp, another user may have placed a file or
a link at the output path. Writing through a link would overwrite the target of the link.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from softfinger.kinematics.compiled.own_folder import (
    HAS_OWNERS,
    NO_FOLLOW,
    require_own,
    user_cache,
)

IN_USE = "is in use; is another softfinger running?"
SIZE_MAX = 16 << 20  # maximum size of a file read in one piece, or of one unpacked part [bytes]


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises OSError on failure or if the path is a device or a pipe.
    """
    mode = path.stat().st_mode  # Check the type first; opening a device may have side effects.
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "found a device or a pipe, expected a regular file", str(path))
    no_wait = getattr(os, "O_NONBLOCK", 0)
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | no_wait))


def read_file(path: Path, most: int = SIZE_MAX) -> bytes:
    """Read a file. Raises OSError if the file exceeds ``most`` bytes or `open_regular` fails."""
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"larger than {most >> 10} kB", str(path))
    return data


def unpacked_size_max(file: BinaryIO) -> int:
    """Return the maximum unpacked size: 32 times the file's size on disk, but at least 8 MiB.

    Compression reduces recordings to between a third and a tenth of their size. Holes in a sparse
    file do not count towards its size.
    """
    found = os.fstat(file.fileno())
    room = 512 * found.st_blocks if HAS_OWNERS else found.st_size
    return max(SIZE_MAX // 2, 32 * min(found.st_size, room))


def runtime_folder() -> Path:
    """Return the user's runtime folder, which by default contains an emulated hand's port links.

    The folder is in XDG_RUNTIME_DIR or /run/user. If neither location is usable, the runtime folder
    is in the temporary folder and is named after the user. If another user owns a folder with that
    name, the runtime folder is in the home folder. Raises RuntimeError if there is no home folder
    either.
    """
    named = os.environ.get("XDG_RUNTIME_DIR", "")
    for folder in (Path(named), Path(f"/run/user/{os.geteuid()}")):
        if folder.is_absolute() and os.access(folder, os.W_OK | os.X_OK):
            return folder / "softfinger"
    shared = _shared_folder()
    try:
        require_own(shared)
    except FileNotFoundError:
        return shared
    except OSError:
        return _home_folder()
    return shared


def runtime_fault() -> str:
    """Return the reason why the runtime folder is unusable, or an empty string if it is usable."""
    try:
        require_own(runtime_folder())
    except FileNotFoundError:
        return ""
    except (OSError, RuntimeError) as error:
        return str(error)
    return ""


def socket_folders() -> Iterator[Path]:
    """Yield candidate folders for the user's sockets; another user may own any of them.

    The folders of the login session and the service come first. The parent folders exist.
    """
    session = f"/run/user/{os.geteuid()}"
    for place in (os.environ.get("XDG_RUNTIME_DIR"), "/run/softfinger", session):
        if place:
            yield Path(place, "softfinger")
    yield _shared_folder()
    with contextlib.suppress(RuntimeError, OSError):  # The user has no home folder.
        user_cache().mkdir(parents=True, exist_ok=True)
        yield _home_folder()


def _shared_folder() -> Path:
    return Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"


def _home_folder() -> Path:
    return user_cache() / "run"


def free_socket_path(path: Path, kind: socket.SocketKind) -> str:
    """Remove a killed process's socket file; if ``path`` is still occupied, return the reason."""
    if not path.exists():
        return ""
    if not path.is_socket():
        return "exists but is not a socket"
    with socket.socket(socket.AF_UNIX, kind) as trial:
        trial.setblocking(False)
        try:
            trial.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError):
            path.unlink(missing_ok=True)
            return ""
        except OSError:  # The socket's queue is full, or this user lacks permission.
            pass
    return IN_USE


def write_text(path: Path, append: bool = False, newline: str | None = None) -> TextIO:
    """Open a UTF-8 text file at a user-specified path for overwriting or appending.

    Raises OSError like `open`, also for failed writes. Raises PermissionError if another user owns
    the path, and the path is a link or lies in a world-writable folder.
    """
    file = io.BufferedWriter(_NamedFile(path, "a" if append else "w", opener=_open))
    return io.TextIOWrapper(file, encoding="utf-8", newline=newline)


def write_bytes(path: Path) -> BinaryIO:
    """Open a binary file for overwriting, with the same checks and errors as `write_text`."""
    return io.BufferedWriter(_NamedFile(path, "w", opener=_open))


class _NamedFile(io.FileIO):
    """File whose write errors name the file, as the errors of `open` do."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            error.filename = self.name
            raise


def _open(path: str, flags: int) -> int:
    try:
        there = os.lstat(path)
        _refuse_foreign(path, there)
        # Follow this user's existing link, but not a link that is created after this check.
        follow = stat.S_ISLNK(there.st_mode)
    except FileNotFoundError:
        follow = False
    flags = flags & ~os.O_TRUNC | (0 if follow else NO_FOLLOW)
    descriptor = os.open(path, flags, 0o666)
    try:
        found = os.fstat(descriptor)
        _refuse_foreign(path, found)
        if stat.S_ISREG(found.st_mode) and not flags & os.O_APPEND:
            os.ftruncate(descriptor, 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _refuse_foreign(path: str, found: os.stat_result) -> None:
    strange = HAS_OWNERS and found.st_uid not in (os.geteuid(), 0)
    link = stat.S_ISLNK(found.st_mode)
    if strange and (link or Path(path).parent.stat().st_mode & stat.S_IWOTH):
        what = "this link" if link else "this file in a world-writable folder"
        raise PermissionError(errno.EPERM, f"{what} is owned by another user", path)
