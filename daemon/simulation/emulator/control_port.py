"""The emulated hand's control socket: words of text in, one line back, for faults while it runs.

A Unix socket in the emulator's folder, served by the emulator's own event loop, and its client.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.simulation.emulator.link_folder import FolderError

NAME = "control"
_LONGEST = 4096  # bytes of a message
_LONGEST_REPLY = 1 << 17
_CLIENTS = 8  # at a time
_PATIENCE = 2.0  # s that a client waits for its reply


class NoEmulator(SoftfingerError):
    """No emulator runs in that folder, or it does not answer."""


class ControlPort:
    """Listens at ``folder``/control; each message is handed to ``handle``, whose text goes back."""

    def __init__(self, folder: Path, handle: Callable[[str], str]) -> None:
        """Raises FolderError when the name is taken by something that is no socket."""
        self._handle = handle
        self._folder = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._clients: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            with contextlib.suppress(FileNotFoundError):
                # A killed emulator's; the folder's lock says that it is gone.
                if not stat.S_ISSOCK(os.stat(NAME, dir_fd=self._folder).st_mode):
                    raise FolderError(f"{folder / NAME}: is in the way; move it elsewhere")
                os.unlink(NAME, dir_fd=self._folder)
            self._listener.bind(_address(self._folder))
            self._listener.listen(_CLIENTS)
            self._listener.setblocking(False)
        except BaseException:
            self._listener.close()
            os.close(self._folder)
            raise

    def sockets(self) -> list[socket.socket]:
        """What to wait for; :meth:`serve` those that are readable."""
        return [self._listener, *self._clients]

    def serve(self, ready: list[socket.socket]) -> None:
        """Take new clients and answer one message of each that has sent one."""
        for each in ready:
            if each is self._listener:
                self._accept()
            elif each in self._clients:
                self._answer(each)

    def close(self) -> None:
        """Hang up and take the socket away."""
        for each in self.sockets():
            each.close()
        self._clients.clear()
        with contextlib.suppress(OSError):
            os.unlink(NAME, dir_fd=self._folder)
        os.close(self._folder)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._clients.append(client)
            if len(self._clients) > _CLIENTS:
                self._clients.pop(0).close()

    def _answer(self, client: socket.socket) -> None:
        try:
            data = client.recv(_LONGEST)
            if data:
                client.send(self._handle(data.decode("utf-8", "replace")).encode())
                return
        except OSError:
            pass
        self._clients.remove(client)
        client.close()


def send_words(folder: Path, text: str) -> str:
    """Send ``text`` to the emulator in ``folder``; its reply.

    Raises:
        NoEmulator: none runs there, or it does not answer.
    """
    try:
        with _directory(folder) as descriptor:
            client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with client:
                client.settimeout(_PATIENCE)
                client.connect(_address(descriptor))
                client.send(text.encode())
                reply = client.recv(_LONGEST_REPLY)
    except OSError:
        raise NoEmulator(f"{folder}: no emulator answers here") from None
    if not reply:
        raise NoEmulator(f"{folder}: the emulator ended")
    return reply.decode()


@contextlib.contextmanager
def _directory(folder: Path) -> Iterator[int]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _address(folder: int) -> str:
    """The socket's address by the folder's descriptor: a whole path may not pass 107 bytes."""
    return f"/proc/self/fd/{folder}/{NAME}"
