"""Addresses that the gateway listens on; one that another daemon has is refused with the reason."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from pathlib import Path
from typing import Any

import zmq

from softfinger.daemon.errors import AddressError

_LOCK = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW


class Address:
    """A socket's address, ours until it is closed.

    Whoever binds an ipc address replaces a file that another process listens on: a lock beside it
    keeps it.
    """

    def __init__(self, socket: zmq.Socket[Any], address: str, key: str, ipc_mode: int) -> None:
        """Bind. ``key`` is the setting that names the address. Raises AddressError."""
        self._path = ""
        self._lock = -1
        before = os.umask(0o777 & ~ipc_mode)  # its rights from the first: nobody slips in before
        try:
            if address.startswith("ipc://"):
                path = address.removeprefix("ipc://")
                self._lock = _lock(path, address, key)
                self._path = path
            # libzmq binds numbers alone.
            socket.bind(address.replace("tcp://localhost:", "tcp://127.0.0.1:"))
            if self._path:
                Path(self._path).chmod(ipc_mode)
        except (zmq.ZMQError, OSError) as error:
            self.close()
            raise _bind_error(address, key, error) from None
        finally:
            os.umask(before)

    def close(self) -> None:
        """Give it back."""
        if self._path:
            for path in (self._path, self._path + ".lock"):
                with contextlib.suppress(OSError):
                    Path(path).unlink()
            os.close(self._lock)
            self._path = ""


def _bind_error(address: str, key: str, error: zmq.ZMQError | OSError) -> AddressError:
    if error.errno == errno.EADDRINUSE:
        return AddressError(f"{key}: {address} is in use; is another softfinger running?")
    return AddressError(f"{key}: can't bind {address}: {error.strerror}")


def _lock(path: str, address: str, key: str) -> int:
    descriptor = os.open(path + ".lock", _LOCK, 0o600)
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
