"""Provide a local socket for ``stop`` that other clients can't block.

The socket is a Unix datagram socket, so the daemon can't run out of connections. Only the daemon's
user can send to the socket. `client.command_client` uses the socket if it exists.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
from collections import deque
from typing import Any

import msgpack

from softfinger.daemon.errors import AddressError
from softfinger.daemon.own_files import free_socket_path, socket_folders
from softfinger.kinematics.compiled.own_folder import require_own

_LOCAL_HOSTS = ("localhost", "*", "0.0.0.0", "[::]")  # hosts that include 127.0.0.1
_DATAGRAM_SIZE_MAX = 4096  # bytes
_SENDER_COUNT_MAX = 16  # maximum number of senders that await a reply


class LocalStop:
    """The daemon's end of the socket. The socket is named after the command address.

    If another user can write to the preferred folder, another folder is used, and ``notice``
    explains why.
    """

    def __init__(self, address: str) -> None:
        """Bind the socket. Raises AddressError."""
        self.notice = trouble = ""
        self._senders: deque[Any] = deque(maxlen=_SENDER_COUNT_MAX)
        for folder in socket_folders():
            self._path = folder / _name(address)
            try:
                folder.mkdir(mode=0o700, exist_ok=True)
                require_own(folder)
                if taken := free_socket_path(self._path, socket.SOCK_DGRAM):
                    raise AddressError(f"commands.address: {address} {taken}")
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
                self._socket.setblocking(False)
                os.fchmod(self._socket.fileno(), 0o600)  # mode of the file that `bind` creates
                self._socket.bind(str(self._path))
            except OSError as error:
                trouble = f"{folder}: {error.strerror}"
                if error.errno is None:  # raised by `require_own`
                    self.notice = trouble = str(error)
            else:
                self.notice += f"; the local stop socket is in {folder}" * bool(self.notice)
                return
        raise AddressError(f"commands.address: can't create the local stop socket: {trouble}")

    def take(self) -> bool:
        """Read one datagram; return True if a stop has arrived."""
        try:
            _, sender = self._socket.recvfrom(_DATAGRAM_SIZE_MAX)
        except OSError:  # The queue is empty.
            return False
        self._senders.append(sender)
        return True

    def answer(self, reply: bytes) -> None:
        """Send the reply to all clients that sent a stop."""
        while self._senders:
            with contextlib.suppress(OSError, TypeError):  # The sender has exited or is unnamed.
                self._socket.sendto(reply, self._senders.popleft())

    def close(self) -> None:
        """Close the socket and remove its file."""
        self._socket.close()
        with contextlib.suppress(OSError):
            self._path.unlink()


def stop_locally(address: str, seconds: float) -> dict[str, Any] | None:
    """Stop this user's daemon that uses the command address ``address``; return its reply.

    Returns None if this user's daemon is not running on this machine or does not respond.
    """
    for folder in socket_folders() if hasattr(socket, "AF_UNIX") else ():
        with (
            contextlib.suppress(OSError, ValueError, msgpack.UnpackException),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking,
        ):
            require_own(folder)
            asking.settimeout(seconds)
            # The system assigns a name to the socket, and the daemon replies to this name.
            asking.bind("")
            asking.connect(str(folder / _name(address)))
            asking.send(b"stop")
            reply = msgpack.unpackb(asking.recv(_DATAGRAM_SIZE_MAX))
            if isinstance(reply, dict):
                return reply
    return None


def _name(address: str) -> str:
    """Return the file name of the socket that belongs to a command address."""
    kind, _, place = address.partition("://")
    if kind == "ipc":
        return f"stop-{hashlib.sha256(os.path.realpath(place).encode()).hexdigest()[:16]}"
    host, _, port = place.rpartition(":")
    return f"stop-{'127.0.0.1' if host in _LOCAL_HOSTS else host.strip('[]')}-{port}"
