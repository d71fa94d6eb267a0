"""Folders that this user alone fills, judged with every folder above them; files written whole.

Whoever may write in a folder above may put another in its place, also between a check and a use: so
a folder is opened once, files are read through that descriptor, and each file's owner is checked.
"""

from __future__ import annotations

import contextlib
import os
import stat
from functools import cache
from pathlib import Path

# Windows has neither owners nor modes that tell who may write, nor folders that stay open: there
# nothing is judged, and the access lists of the user's profile have to do.
JUDGED = hasattr(os, "geteuid")
NO_FOLLOW: int = getattr(os, "O_NOFOLLOW", 0)
_PLAIN: int = NO_FOLLOW | getattr(os, "O_BINARY", 0)


def user_cache() -> Path:
    """Return this program's cache directory of the user. Raises RuntimeError without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "softfinger" if base else Path.home() / ".cache" / "softfinger"


def fault(path: Path, found: os.stat_result) -> str:
    """Return why others may change what is at ``path``, of status ``found``; empty if they may not.

    It is this user's or root's. In a folder with the sticky bit, as /tmp, nobody can replace what
    isn't his.
    """
    if not JUDGED:
        return ""
    if found.st_uid not in (0, os.geteuid()):
        return f"{path}: belongs to user {found.st_uid}, expected {os.geteuid()}, who runs this"
    if found.st_mode & stat.S_ISVTX and stat.S_ISDIR(found.st_mode):
        return ""
    return _written_by_others(path, found)


def _written_by_others(path: Path, found: os.stat_result) -> str:
    if not JUDGED:
        return ""
    others = stat.S_IWOTH | (0 if _alone_in(found.st_gid) else stat.S_IWGRP)
    mode = stat.S_IMODE(found.st_mode)
    return f"{path}: may be written by others ({mode:04o}): chmod go-w {path}" * bool(mode & others)


@cache
def _alone_in(group: int) -> bool:
    """Return whether a group is this user's private one: of its name, with nobody else in it."""
    import grp
    import pwd

    try:
        found, user = grp.getgrgid(group), pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return found.gr_name == user and {*found.gr_mem} <= {user}


def check_above(path: Path) -> None:
    """Judge all folders above ``path``. Raises PermissionError, and OSError as `Path.stat`."""
    for folder in path.resolve().parents:
        if wrong := fault(folder, folder.stat()):
            raise PermissionError(wrong)


def require_own(folder: Path) -> None:
    """Raises PermissionError unless this folder, no link, is this user's and nobody else's to fill.

    Raises FileNotFoundError and NotADirectoryError, too.
    """
    _judge(folder, folder.lstat())


def _judge(folder: Path, found: os.stat_result) -> None:
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{folder}: found a link or a file, expected a folder")
    check_above(folder)
    if wrong := fault(folder, found) or _written_by_others(folder, found):
        raise PermissionError(wrong)


def write_whole(
    path: str | Path, data: bytes, mode: int = 0o666, folder: int | None = None
) -> None:
    """Write a file beside its place and move it there: it appears whole, or not at all.

    ``path`` is of the open directory ``folder`` where there is one. Raises OSError.
    """
    part = f"{path}.{os.getpid()}.part"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _PLAIN
    _remove(part, folder)
    try:
        with os.fdopen(os.open(part, flags, mode, dir_fd=folder), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path, src_dir_fd=folder, dst_dir_fd=folder)
    except OSError:
        _remove(part, folder)
        raise


def _remove(path: str, folder: int | None) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path, dir_fd=folder)


class OwnFolder:
    """A context of a folder that is this user's alone, made (0700) if absent, and kept open.

    Raises OSError as :func:`require_own`, or where it can't be made.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_symlink() and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
        require_own(path)
        self.path = path
        self.descriptor: int | None = None
        if not JUDGED:
            return
        self.descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | NO_FOLLOW)
        try:
            _judge(path, os.fstat(self.descriptor))
            if not os.access(path, os.W_OK | os.X_OK):
                raise PermissionError(f"{path}: may not be written to")
        except OSError:
            self.close()
            raise

    def names(self) -> list[str]:
        """Return the names of what is in it."""
        return os.listdir(self.path if self.descriptor is None else self.descriptor)  # noqa: PTH208

    def read(self, name: str) -> bytes:
        """Return a file's bytes. Raises OSError as `open`, PermissionError for another user's."""
        flags = os.O_RDONLY | _PLAIN
        descriptor = os.open(self._at(name), flags, dir_fd=self.descriptor)
        with os.fdopen(descriptor, "rb") as file:
            if wrong := fault(self.path / name, os.fstat(descriptor)):
                raise PermissionError(wrong)
            return file.read()

    def write(self, name: str, data: bytes) -> None:
        """Write a file as :func:`write_whole`, for this user alone. Raises OSError."""
        write_whole(self._at(name), data, 0o600, self.descriptor)

    def remove(self, name: str) -> None:
        """Remove a file, if it is there. Raises OSError."""
        _remove(self._at(name), self.descriptor)

    def _at(self, name: str) -> str:
        return str(self.path / name) if self.descriptor is None else name

    def close(self) -> None:
        """Give it back."""
        if self.descriptor is not None:
            os.close(self.descriptor)

    def __enter__(self) -> OwnFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
