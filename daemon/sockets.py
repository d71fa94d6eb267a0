"""Binding the daemon's sockets so that a second daemon is told and nobody's socket is taken."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import select
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import zmq

from daemon.keys import DOMAIN, HANDSHAKE, ServerKeys

_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)  # plain numbers: enum flags cost a microsecond

# The system's poll without giving up the GIL, which to get back may cost a whole switch interval.
_poll = ctypes.PyDLL(None).poll


class _PollFd(ctypes.Structure):
    """One descriptor, as the system's poll takes it."""

    _fields_ = (("fd", ctypes.c_int), ("events", ctypes.c_short), ("revents", ctypes.c_short))


class AddressError(Exception):
    """A socket can't be bound: the address is in use or can't be had."""


@dataclass(frozen=True, slots=True)
class Guard:
    """Who may connect: rights of an ipc address's file, and keys where there are some."""

    ipc_mode: int = 0o600
    keys: ServerKeys | None = None
    asks: bool = False  # a `Doorkeeper`, without keys, too; nobody is let in until there is one


OWNER_ONLY = Guard()


class Bound:
    """A bound ZeroMQ socket and, for ipc, the lock file that keeps the address ours.

    libzmq replaces an ipc file that another process listens on without a word, hence the lock.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        kind: int,
        address: str,
        key: str,
        queue: int,
        max_bytes: int,
        guard: Guard = OWNER_ONLY,
    ) -> None:
        self._lock = -1
        self._file = ""
        if address.startswith("ipc://"):
            path = address.removeprefix("ipc://")
            self._lock = _lock(path, address, key)
            self._file = path
        self.socket: zmq.Socket[Any] = context.socket(kind)
        self.socket.setsockopt(zmq.LINGER, 200)
        # These bounds hold only for connections made after they were set, so before bind.
        self.socket.setsockopt(zmq.MAXMSGSIZE, max_bytes)
        self.socket.setsockopt(zmq.SNDHWM, queue)
        self.socket.setsockopt(zmq.RCVHWM, queue)
        if guard.keys is not None:
            guard.keys.guard(self.socket)
        elif guard.asks:
            self.socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
            self.socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
            self.socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE)
        # The file comes into being with its rights, so that nobody slips in before.
        before = os.umask(0o777 & ~guard.ipc_mode) if self._file else -1
        try:
            self.socket.bind(address)
            if self._file:
                Path(self._file).chmod(guard.ipc_mode)
        except zmq.ZMQError as error:
            self.close()
            if error.errno == zmq.EADDRINUSE:
                raise AddressError(
                    f"{key}: {address} is in use; is another softfinger running?"
                ) from None
            raise AddressError(f"{key}: can't bind {address}: {error}") from None
        except OSError as error:
            self.close()
            raise AddressError(f"{key}: {address}: {error.strerror}") from None
        finally:
            if before >= 0:
                os.umask(before)
        descriptor = cast(int, self.socket.getsockopt(zmq.FD))
        self._asked = ctypes.byref(_PollFd(descriptor, select.POLLIN, 0))

    def signalled(self) -> bool:
        """Something may have come since `readable` last said no, if nothing was sent since then.

        libzmq's descriptor tells of a change once, not of what waits; a third of `readable`'s time.
        """
        return bool(_poll(self._asked, 1, 0))

    def readable(self) -> bool:
        """A message waits. About a microsecond."""
        return bool(cast(int, self.socket.getsockopt(_EVENTS)) & _POLLIN)

    def close(self) -> None:
        """Close the socket and give the address back."""
        self.socket.close()
        if self._lock >= 0:
            for path in (self._file, self._file + ".lock"):
                with contextlib.suppress(OSError):
                    Path(path).unlink()
            os.close(self._lock)
            self._lock = -1


def _lock(path: str, address: str, key: str) -> int:
    try:
        descriptor = os.open(path + ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
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
