"""A way for ``stop`` that no client's connections can take: a socket for this user alone.

Datagrams to a Unix socket, so there is nothing to connect, to wait for or to use up. It lies in a
folder that only the daemon's user may enter; `client.command_client` takes it where it is there.
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

_ANY = ("localhost", "*", "0.0.0.0", "[::]")  # and addresses that mean this machine, too
_LONGEST = 4096  # bytes
_ASKERS = 16  # who wait for the answer
_A_TICK = 4  # taken at one; the system keeps few more


class LocalStop:
    """The daemon's end. The socket is named after ``address``, where it takes commands.

    ``notice`` says where it is, if not where it should be.
    """

    def __init__(self, address: str) -> None:
        """Raises AddressError."""
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
                f"commands.address: the local socket for stop: {error.filename or ''} "
                f"{error.strerror or error}"
            ) from None
        self._askers: deque[Any] = deque(maxlen=_ASKERS)

    def take(self) -> bool:
        """Return whether a stop has come."""
        came = False
        for _ in range(_A_TICK):
            try:
                _, asker = self._socket.recvfrom(_LONGEST)
            except OSError:  # nothing more
                break
            came = True
            if asker:
                self._askers.append(asker)
        return came

    def fileno(self) -> int:
        """Return the descriptor at which it comes."""
        return self._socket.fileno()

    def answer(self, reply: bytes) -> None:
        """Answer all who asked."""
        while self._askers:
            with contextlib.suppress(OSError):  # it has gone
                self._socket.sendto(reply, self._askers.popleft())

    def close(self) -> None:
        """Take it away."""
        self._socket.close()
        with contextlib.suppress(OSError):
            self._path.unlink()


def stop_locally(address: str, seconds: float) -> dict[str, Any] | None:
    """Stop the daemon of this user that takes commands at ``address``; its reply.

    None when there is none on this machine, or it doesn't answer so.
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
                asking.bind("")  # a name of the system's choice, for the answer
                asking.connect(str(folder / name))
                asking.send(b"stop")
                reply = msgpack.unpackb(asking.recv(_LONGEST))
            except (OSError, ValueError, msgpack.UnpackException):
                continue
        if isinstance(reply, dict):
            return reply
    return None


def _name(address: str) -> str:
    """Return what the socket is called. Raises ValueError for an address of another machine."""
    kind, _, place = address.partition("://")
    if kind == "ipc":
        return f"stop-{hashlib.sha256(os.path.realpath(place).encode()).hexdigest()[:16]}"
    host, _, port = place.rpartition(":")
    host = "127.0.0.1" if host in _ANY else host.strip("[]")
    if not ipaddress.ip_address(host).is_loopback:
        raise ValueError(f"{address} is not of this machine")
    return f"stop-{host}-{port}"


def _folders() -> Iterator[Path]:
    """Return where it may be: of a system service, of this session, of no session at all."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        if place := os.environ.get(name):
            yield Path(place.split(":")[0]) / "softfinger"
    yield Path("/run/softfinger/softfinger")
    yield Path(f"/run/user/{os.geteuid()}/softfinger")
    yield shared_folder()
    with contextlib.suppress(RuntimeError):  # no home
        folder = home_folder()
        with contextlib.suppress(OSError):
            folder.parent.mkdir(parents=True, exist_ok=True)
        yield folder


def _own_folder() -> tuple[Path, str]:
    """The first that can be had, made if need be, and why none before it. Raises OSError."""
    refused: OSError | None = None
    notice = ""
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            refused = error
            continue
        if _is_ours(folder):
            return folder, notice and f"{notice}; the local stop is in {folder}"
        refused = PermissionError(1, "is not this user's alone", str(folder))
        ours = folder.lstat().st_uid == os.geteuid()
        notice = f"{folder} is not this user's alone{f' (chmod 700 {folder})' * ours}"
    assert refused is not None
    raise refused


def _is_ours(folder: Path) -> bool:
    """Return whether it is this user's, no link, and nobody else may even look into it."""
    try:
        require_own(folder)
    except OSError:
        return False
    found = folder.stat()
    return found.st_uid == os.geteuid() and not found.st_mode & 0o077


def _remove_dead(path: Path, address: str) -> None:
    """Take away the socket of a daemon that was killed. Raises AddressError when one lives."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as trial:
        try:
            trial.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            path.unlink()
            return
    raise AddressError(f"commands.address: {address} is in use; is another softfinger running?")
