"""Folders that this user alone fills, judged with every folder above them, and read as they are.

Whoever may write in a folder above may put another in its place, between a look and a use, too: so
a folder is opened once, and what is read comes through that, each file's owner looked at.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import stat
from functools import cache
from pathlib import Path


def user_cache() -> Path:
    """Return this program's cache directory of the user. Raises RuntimeError without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "softfinger" if base else Path.home() / ".cache" / "softfinger"


def fault(path: Path, found: os.stat_result) -> str:
    """Return why others may change what is at ``path``, of status ``found``; empty if they may not.

    It is this user's or root's. In a folder with the sticky bit, as /tmp, nobody can replace what
    isn't his.
    """
    if found.st_uid not in (0, os.geteuid()):
        return f"{path}: belongs to user {found.st_uid}, expected {os.geteuid()}, who runs this"
    if found.st_mode & stat.S_ISVTX and stat.S_ISDIR(found.st_mode):
        return ""
    return _written_by_others(path, found)


def _written_by_others(path: Path, found: os.stat_result) -> str:
    others = stat.S_IWOTH | (0 if _alone_in(found.st_gid) else stat.S_IWGRP)
    mode = stat.S_IMODE(found.st_mode)
    return f"{path}: may be written by others ({mode:04o}): chmod go-w {path}" * bool(mode & others)


@cache
def _alone_in(group: int) -> bool:
    """Return whether a group is this user's private one: of its name, with nobody else in it."""
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


class OwnFolder:
    """A context of a folder that is this user's alone, made (0700) if absent, and kept open.

    Raises PermissionError where others may change what is in it or above it, NotADirectoryError
    where it is something else, OSError where it can't be made or written.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_symlink() and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
        if path.is_symlink() or not path.is_dir():
            raise NotADirectoryError(f"{path}: found a link or a file, expected a folder")
        check_above(path)
        self.path = path
        self.descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        found = os.fstat(self.descriptor)
        if wrong := fault(path, found) or _written_by_others(path, found):
            self.close()
            raise PermissionError(wrong)
        if not os.access(path, os.W_OK | os.X_OK):
            self.close()
            raise PermissionError(f"{path}: may not be written to")

    def names(self) -> list[str]:
        """Return the names of what is in it."""
        return os.listdir(self.descriptor)  # noqa: PTH208

    def read(self, name: str) -> bytes:
        """Return a file's bytes. Raises OSError as `open`, PermissionError for another user's."""
        descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW, dir_fd=self.descriptor)
        with os.fdopen(descriptor, "rb") as file:
            if wrong := fault(self.path / name, os.fstat(descriptor)):
                raise PermissionError(wrong)
            return file.read()

    def write(self, name: str, data: bytes) -> None:
        """Write a file: it appears whole and on the disk, or not at all. Raises OSError."""
        part = f"{name}.{os.getpid()}.part"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        self.remove(part)
        try:
            with os.fdopen(os.open(part, flags, 0o600, dir_fd=self.descriptor), "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, name, src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)
        except OSError:
            self.remove(part)
            raise

    def remove(self, name: str) -> None:
        """Remove a file, if it is there. Raises OSError."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self.descriptor)

    def close(self) -> None:
        """Give it back."""
        os.close(self.descriptor)

    def __enter__(self) -> OwnFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
