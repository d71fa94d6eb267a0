"""Addresses that the daemon listens on; one that another daemon has is refused with the reason."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from softfinger.daemon.errors import AddressError

_INFO = struct.Struct("=24xI")  # struct tcp_info, of a listener: connections that wait
_LOCK = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_BACKLOG = 1024  # connections that wait to be accepted; the system may allow less


class IpcFile:
    """The file of an ipc address, and the lock beside it that keeps the address ours.

    Whoever binds such an address replaces a file that another process listens on, hence the lock.
    """

    def __init__(self, address: str, key: str, mode: int) -> None:
        """``key`` is the setting that names the address. Raises AddressError."""
        self.path = address.removeprefix("ipc://")
        self._mode = mode
        self._lock = _lock(self.path, address, key)

    @contextmanager
    def coming_into_being(self) -> Iterator[None]:
        """Around bind: the file has its rights from the first, so that nobody slips in before."""
        before = os.umask(0o777 & ~self._mode)
        try:
            yield
            Path(self.path).chmod(self._mode)
        finally:
            os.umask(before)

    def close(self) -> None:
        """Give the address back."""
        if self._lock >= 0:
            for path in (self.path, self.path + ".lock"):
                with contextlib.suppress(OSError):
                    Path(path).unlink()
            os.close(self._lock)
            self._lock = -1


class Listener:
    """A socket that listens on a tcp or ipc address and never blocks."""

    def __init__(self, address: str, key: str, ipc_mode: int) -> None:
        """``key`` is the setting that names the address. Raises AddressError."""
        self._file: IpcFile | None = None
        kind, _, place = address.partition("://")
        if kind == "ipc":
            self._file = IpcFile(address, key, ipc_mode)
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        else:
            host, _, port = place.rpartition(":")
            host = host.strip("[]")
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.socket(family, socket.SOCK_STREAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.setblocking(False)
        try:
            if self._file is not None:
                with contextlib.suppress(FileNotFoundError):  # of one that was killed; we lock it
                    Path(self._file.path).unlink()
                with self._file.coming_into_being():
                    self._socket.bind(self._file.path)
            else:
                self._socket.bind((host, int(port)))
            self._socket.listen(_BACKLOG)
        except OSError as error:
            self.close()
            raise bind_error(address, key, error.errno, error.strerror or str(error)) from None

    def fileno(self) -> int:
        return self._socket.fileno()

    def accept(self) -> tuple[socket.socket, Any]:
        """As `socket.socket.accept`."""
        return self._socket.accept()

    def waiting(self) -> int:
        """How many connections wait to be accepted, at most."""
        if self._socket.family == socket.AF_UNIX:
            return _BACKLOG
        known = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO.size)
        return int(_INFO.unpack(known)[0])

    def close(self) -> None:
        """Give the address back."""
        self._socket.close()
        if self._file is not None:
            self._file.close()


def bind_error(address: str, key: str, number: int | None, reason: str) -> AddressError:
    """What to raise when an address can't be bound."""
    if number == errno.EADDRINUSE:
        return AddressError(f"{key}: {address} is in use; is another softfinger running?")
    return AddressError(f"{key}: can't bind {address}: {reason}")


def _lock(path: str, address: str, key: str) -> int:
    try:
        descriptor = os.open(path + ".lock", _LOCK, 0o600)
    except OSError as error:
        raise AddressError(f"{key}: can't bind {address}: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise AddressError(f"{key}: {address} is in use; is another softfinger running?") from None
    if Path(path).exists() and not Path(path).is_socket():
        os.close(descriptor)
        Path(path + ".lock").unlink()
        raise AddressError(f"{key}: {path} is there already and is no socket")
    return descriptor
