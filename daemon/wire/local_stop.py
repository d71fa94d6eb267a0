"""Provide a local socket for ``stop`` that other clients can't block.

The socket is a Unix datagram socket, so connections can't run out. Only the daemon's user has
access to the socket's folder. `client.command_client` uses the socket if it exists.
"""

from __future__ import annotations

import contextlib
import hashlib
import ipaddress
import os
import socket
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack

from softfinger.daemon.errors import AddressError
from softfinger.daemon.own_files import home_folder, shared_folder
from softfinger.kinematics.compiled.own_folder import require_own

_LOCAL_HOSTS = ("localhost", "*", "0.0.0.0", "[::]")  # names for 127.0.0.1 on this machine
_DATAGRAM_SIZE_MAX = 4096  # bytes
_SENDER_COUNT_MAX = 16  # maximum number of senders that await a reply
_DATAGRAMS_PER_TICK = 4  # reads per tick; the system's queue holds only a few more datagrams


class LocalStop:
    """The daemon's end of the socket, which is named after the command address.

    If the socket is not in the preferred folder, ``notice`` gives the reason and the location.
    """

    def __init__(self, address: str) -> None:
        """Bind the socket. Raises AddressError."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            folder, self.notice = _own_folder()
            self._path = folder / _name(address)
            _remove_dead(self._path, address)
            before = os.umask(0o177)
            try:
                self._socket.bind(str(self._path))
            finally:
                os.umask(before)
        except OSError as error:
            self._socket.close()
            raise AddressError(
                f"commands.address: can't create the local stop socket: {error.filename or ''} "
                f"{error.strerror or error}"
            ) from None
        self._senders: deque[Any] = deque(maxlen=_SENDER_COUNT_MAX)

    def take(self) -> bool:
        """Read queued datagrams, and return True if a stop arrived."""
        came = False
        for _ in range(_DATAGRAMS_PER_TICK):
            try:
                _, asker = self._socket.recvfrom(_DATAGRAM_SIZE_MAX)
            except OSError:  # The queue is empty.
                break
            came = True
            if asker:
                self._senders.append(asker)
        return came

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._socket.fileno()

    def answer(self, reply: bytes) -> None:
        """Send the reply to all clients that sent a stop."""
        while self._senders:
            with contextlib.suppress(OSError):  # The sender has ended.
                self._socket.sendto(reply, self._senders.popleft())

    def close(self) -> None:
        """Close the socket and remove its file."""
        self._socket.close()
        with contextlib.suppress(OSError):
            self._path.unlink()


def stop_locally(address: str, seconds: float) -> dict[str, Any] | None:
    """Stop this user's daemon at the command address ``address``, and return its reply.

    Returns None if this user's daemon is not running on this machine or does not respond.
    """
    try:
        name = _name(address)
    except ValueError:
        return None
    if not hasattr(socket, "AF_UNIX"):
        return None
    for folder in _folders():
        if not _is_ours(folder):
            continue
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
            asking.settimeout(seconds)
            try:
                # The system assigns a name to the socket, and the daemon replies to this name.
                asking.bind("")
                asking.connect(str(folder / name))
                asking.send(b"stop")
                reply = msgpack.unpackb(asking.recv(_DATAGRAM_SIZE_MAX))
            except (OSError, ValueError, msgpack.UnpackException):
                continue
        if isinstance(reply, dict):
            return reply
    return None


def _name(address: str) -> str:
    """Return the socket's name. Raises ValueError if the address is not on this machine."""
    kind, _, place = address.partition("://")
    if kind == "ipc":
        return f"stop-{hashlib.sha256(os.path.realpath(place).encode()).hexdigest()[:16]}"
    host, _, port = place.rpartition(":")
    host = "127.0.0.1" if host in _LOCAL_HOSTS else host.strip("[]")
    if not ipaddress.ip_address(host).is_loopback:
        raise ValueError(f"{address} is not an address of this machine")
    return f"stop-{host}-{port}"


def _folders() -> Iterator[Path]:
    """Yield candidate folders: those of a system service and of a login session, then fallbacks."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        if place := os.environ.get(name):
            yield Path(place.split(":")[0]) / "softfinger"
    yield Path("/run/softfinger/softfinger")
    yield Path(f"/run/user/{os.geteuid()}/softfinger")
    yield shared_folder()
    with contextlib.suppress(RuntimeError):  # The user has no home folder.
        folder = home_folder()
        with contextlib.suppress(OSError):
            folder.parent.mkdir(parents=True, exist_ok=True)
        yield folder


def _own_folder() -> tuple[Path, str]:
    """Return the first usable folder, created if necessary, and a notice on unusable folders.

    Raises OSError if all candidates are unusable.
    """
    refused: OSError | None = None
    notice = ""
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            refused = error
            continue
        if _is_ours(folder):
            return folder, notice and f"{notice}; the local stop socket is in {folder}"
        refused = PermissionError(1, "is not private to this user", str(folder))
        ours = folder.lstat().st_uid == os.geteuid()
        notice = f"{folder} is not private to this user{f' (chmod 700 {folder})' * ours}"
    assert refused is not None
    raise refused


def _is_ours(folder: Path) -> bool:
    """Return True if the folder is not a link, and only its owner, this user, can access it."""
    try:
        require_own(folder)
    except OSError:
        return False
    found = folder.stat()
    return found.st_uid == os.geteuid() and not found.st_mode & 0o077


def _remove_dead(path: Path, address: str) -> None:
    """Remove the socket file of a killed daemon. Raises AddressError if the daemon is running."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as trial:
        try:
            trial.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            path.unlink()
            return
    raise AddressError(f"commands.address: {address} is in use; is another softfinger running?")
