"""The folder in which an emulator links its ports, held by one emulator at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.own_files import require_own

LINKS = ("servos", "tactile-left", "tactile-right")
_LOCK = ".emulator.lock"


class FolderError(SoftfingerError):
    """The folder can't be used. The message says why, and how to fix it."""


class LinkFolder:
    """The folder with the links to the ptys, held by one emulator at a time.

    It must be this user's, and no other may write in it.
    Links that a killed emulator left behind are replaced; anything else in their place is not.
    """

    def __init__(self, path: Path) -> None:
        """Raises FolderError when the folder is in use or can't be used."""
        self.path = path
        self._links: dict[Path, str] = {}
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            require_own(path)
            self._lock = self._take(path / _LOCK)
        except OSError as error:
            raise FolderError(f"{path}: can't be used as --dir: {error.strerror}") from None
        for name in LINKS:
            place = path / name
            if place.exists() and not place.is_symlink():
                self.close()
                raise FolderError(f"{place}: is in the way and is no link; move it elsewhere")

    def _take(self, path: Path) -> int:
        while True:
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.read(lock, 32).decode("ascii", "replace").strip()
                os.close(lock)
                raise FolderError(
                    f"{self.path}: in use by another emulator (process {holder or 'unknown'}); "
                    "end that one or choose another --dir"
                ) from None
            # The holder before us may have removed the file between our open and our lock.
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_ino == os.fstat(lock).st_ino:
                    os.ftruncate(lock, 0)
                    os.write(lock, f"{os.getpid()}\n".encode())
                    return lock
            os.close(lock)

    def link(self, name: str, target: str) -> None:
        """Put the link ``name`` to ``target`` in place, whole at any instant."""
        place = self.path / name
        fresh = self.path / f".{name}.{os.getpid()}"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target)
        fresh.replace(place)
        self._links[place] = target

    def unlink(self, name: str) -> None:
        """Remove the link ``name``, unless it leads elsewhere by now."""
        target = self._links.pop(self.path / name, "")
        with contextlib.suppress(OSError):
            if str((self.path / name).readlink()) == target:
                (self.path / name).unlink()

    def close(self) -> None:
        """Remove what is ours: the links, unless they lead elsewhere by now, and the lock."""
        for place in list(self._links):
            self.unlink(place.name)
        with contextlib.suppress(OSError):
            (self.path / _LOCK).unlink()
        with contextlib.suppress(OSError):
            os.close(self._lock)
