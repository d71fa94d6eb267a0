"""Files that a person or another file names, read within bounds; and files that only we write.

A name may lead to a device, to a pipe that nobody fills, to more than memory holds. In a folder
such as /tmp anybody may have put a link or a file where one of ours is to be: what is written would
go into whatever that leads to.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path
from typing import BinaryIO, Literal, TextIO

from softfinger.kinematics.compiled.own_folder import (
    JUDGED,
    NO_FOLLOW,
    require_own,
    user_cache,
)

MOST = 16 << 20  # bytes of a file that is read at once, or of what a part of one unpacks to

_SHARED = stat.S_IWOTH


def open_regular(path: Path) -> BinaryIO:
    """Open a file to be read. Raises OSError as `open`, and for a device or a pipe."""
    mode = path.stat().st_mode  # opening alone may act on a device
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "a device or a pipe, expected a file", str(path))
    no_wait = getattr(os, "O_NONBLOCK", 0)
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | no_wait))


def read_file(path: Path, most: int = MOST) -> bytes:
    """Return a file's bytes. Raises OSError as `open_regular`, and for more than ``most`` bytes."""
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"more than {most >> 10} kB", str(path))
    return data


def unpacked_most(file: BinaryIO) -> int:
    """Return how many bytes a file may unpack to: 32 times the room that it takes on its disk.

    Recordings take a third to a tenth of what they hold; holes in a file take no room.
    """
    found = os.fstat(file.fileno())
    room = 512 * found.st_blocks if JUDGED else found.st_size
    return max(MOST // 2, 32 * min(found.st_size, room))


def runtime_folder() -> Path:
    """The user's own runtime folder, where an emulated hand links its ports by default.

    Without one (XDG_RUNTIME_DIR, /run/user), a folder named after the user where temporary files
    are, or at home where another user has made that. Raises RuntimeError without a home, too.
    """
    named = os.environ.get("XDG_RUNTIME_DIR", "")
    for folder in (Path(named), Path(f"/run/user/{os.geteuid()}")):
        if folder.is_absolute() and os.access(folder, os.W_OK | os.X_OK):
            return folder / "softfinger"
    shared = shared_folder()
    try:
        require_own(shared)
    except FileNotFoundError:
        return shared
    except OSError:
        return home_folder()
    return shared


def runtime_fault() -> str:
    """Return why the runtime folder can't be used and what mends it; empty where it can."""
    try:
        require_own(runtime_folder())
    except FileNotFoundError:
        return ""
    except (OSError, RuntimeError) as error:
        return str(error)
    return ""


def shared_folder() -> Path:
    """The folder where temporary files are, which another user may have made before."""
    return Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"


def home_folder() -> Path:
    """The folder at home for want of another. Raises RuntimeError without a home."""
    return user_cache() / "run"


def write_text(path: Path, append: bool = False, newline: str | None = None) -> TextIO:
    """Open a file of text, UTF-8, that a person named, to be overwritten or appended to.

    Raises OSError as `open` does, and PermissionError for what another user has put there: a link,
    or in a folder that all may write in any file.
    """
    mode: Literal["a", "w"] = "a" if append else "w"
    return open(path, mode, encoding="utf-8", newline=newline, opener=_open)


def write_bytes(path: Path) -> BinaryIO:
    """The same for bytes."""
    return open(path, "wb", opener=_open)


def _open(path: str, flags: int) -> int:
    try:
        there = os.lstat(path)
        _refuse_strange(path, there)
        # Our own link may be followed; none may appear from here on.
        follow = stat.S_ISLNK(there.st_mode)
    except FileNotFoundError:
        follow = False
    flags = flags & ~os.O_TRUNC | (0 if follow else NO_FOLLOW)
    descriptor = os.open(path, flags, 0o666)
    try:
        found = os.fstat(descriptor)
        _refuse_strange(path, found)
        if stat.S_ISREG(found.st_mode) and not flags & os.O_APPEND:
            os.ftruncate(descriptor, 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _refuse_strange(path: str, found: os.stat_result) -> None:
    strange = JUDGED and found.st_uid not in (os.geteuid(), 0)
    link = stat.S_ISLNK(found.st_mode)
    if strange and (link or Path(path).parent.stat().st_mode & _SHARED):
        what = "a link" if link else "a file in a folder that all may write in"
        raise PermissionError(errno.EPERM, f"{what}, of another user", path)
