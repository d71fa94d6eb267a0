"""Check that only the current user can modify a folder, and write files atomically.

A user who can write to a parent folder can replace the folder, even after the check. The check
therefore includes all parent folders. The folder is opened once, and files are read through its
descriptor. The check also includes the owner of each file.
"""

from __future__ import annotations

import contextlib
import os
import stat
from functools import cache
from pathlib import Path

# Windows has no owner or mode bits to check and cannot keep a folder open. The access control lists
# of the user profile protect the folder instead.
HAS_OWNERS = hasattr(os, "geteuid")
NO_FOLLOW: int = getattr(os, "O_NOFOLLOW", 0)
_PLAIN: int = NO_FOLLOW | getattr(os, "O_BINARY", 0)


def user_cache() -> Path:
    """Return the program's cache directory. Raises RuntimeError if there is no home directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "softfinger" if base else Path.home() / ".cache" / "softfinger"


def fault(path: Path, found: os.stat_result) -> str:
    """Return the reason why other users can modify ``path``, or "" if they cannot modify it.

    ``found`` is the stat result for the path. The owner must be this user or root. Folders with the
    sticky bit, such as /tmp, are allowed, because only the owner of an entry can replace it.
    """
    if not HAS_OWNERS:
        return ""
    if found.st_uid not in (0, os.geteuid()):
        return f"{path}: is owned by user {found.st_uid}, expected the current user, {os.geteuid()}"
    if found.st_mode & stat.S_ISVTX and stat.S_ISDIR(found.st_mode):
        return ""
    return _written_by_others(path, found)


def _written_by_others(path: Path, found: os.stat_result) -> str:
    if not HAS_OWNERS:
        return ""
    others = stat.S_IWOTH | (0 if _alone_in(found.st_gid) else stat.S_IWGRP)
    mode = stat.S_IMODE(found.st_mode)
    return f"{path}: other users can write to it ({mode:04o}): chmod go-w {path}" * bool(
        mode & others
    )


@cache
def _alone_in(group: int) -> bool:
    """Return True if the group has this user's name and no other members."""
    import grp
    import pwd

    try:
        found, user = grp.getgrgid(group), pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return found.gr_name == user and {*found.gr_mem} <= {user}


def check_above(path: Path) -> None:
    """Check all parent folders of ``path``.

    Raises PermissionError if other users can modify a parent folder, or an OSError from
    `Path.stat`.
    """
    for folder in path.resolve().parents:
        if wrong := fault(folder, folder.stat()):
            raise PermissionError(wrong)


def require_own(folder: Path) -> None:
    """Check that only this user can modify the folder and that it is not a link.

    Raises PermissionError, FileNotFoundError or NotADirectoryError.
    """
    _check_owner(folder, folder.lstat())


def _check_owner(folder: Path, found: os.stat_result) -> None:
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{folder}: found a link or a file, expected a folder")
    check_above(folder)
    if wrong := fault(folder, found) or _written_by_others(folder, found):
        raise PermissionError(wrong)


def write_whole(
    path: str | Path, data: bytes, mode: int = 0o666, folder: int | None = None
) -> None:
    """Write a file atomically, using a temporary file in the same directory.

    If the descriptor ``folder`` of an open directory is given, ``path`` is relative to it. Raises
    OSError.
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
    except OSError as error:
        _remove(part, folder)
        if error.filename is None:
            error.filename = path
        raise


def _remove(path: str, folder: int | None) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path, dir_fd=folder)


class OwnFolder:
    """Context manager for an open folder that only this user can modify.

    The folder is created with mode 0700 if it does not exist. Raises the exceptions of
    :func:`require_own`, or OSError if the folder cannot be created.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_symlink() and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
        require_own(path)
        self.path = path
        self.descriptor: int | None = None
        if not HAS_OWNERS:
            return
        self.descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | NO_FOLLOW)
        try:
            _check_owner(path, os.fstat(self.descriptor))
            if not os.access(path, os.W_OK | os.X_OK):
                raise PermissionError(f"{path}: is not writable")
        except OSError:
            self.close()
            raise

    def names(self) -> list[str]:
        """Return the names of all entries."""
        return os.listdir(self.path if self.descriptor is None else self.descriptor)  # noqa: PTH208

    def read(self, name: str) -> bytes:
        """Return the content of a file.

        Raises an OSError from `open`, or PermissionError if other users can modify the file.
        """
        flags = os.O_RDONLY | _PLAIN
        descriptor = os.open(self._at(name), flags, dir_fd=self.descriptor)
        with os.fdopen(descriptor, "rb") as file:
            if wrong := fault(self.path / name, os.fstat(descriptor)):
                raise PermissionError(wrong)
            return file.read()

    def write(self, name: str, data: bytes) -> None:
        """Atomically write a file that only this user can read. Raises OSError."""
        write_whole(self._at(name), data, 0o600, self.descriptor)

    def remove(self, name: str) -> None:
        """Remove a file if it exists. Raises OSError."""
        _remove(self._at(name), self.descriptor)

    def _at(self, name: str) -> str:
        return str(self.path / name) if self.descriptor is None else name

    def close(self) -> None:
        """Close the folder."""
        if self.descriptor is not None:
            os.close(self.descriptor)

    def __enter__(self) -> OwnFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
