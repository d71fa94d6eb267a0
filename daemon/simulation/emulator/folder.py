"""Manage an emulator's folder, which contains a control socket and links to the ports.

Only one emulator may use a folder at a time. The emulator's event loop replies with one line to
each message that `send_words` sends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import selectors
import socket
import stat
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from softfinger.daemon.errors import Reason, Refused, SoftfingerError
from softfinger.kinematics.compiled.own_folder import require_own

LINKS = ("servos", "tactile-left", "tactile-right")
_LOCK = ".emulator.lock"
_CONTROL = "control"
_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_MESSAGE_SIZE_MAX = 4096  # bytes per message
_REPLY_SIZE_MAX = 1 << 17
_CLIENT_COUNT_MAX = 8  # maximum number of connected clients
_CLIENT_TIMEOUT = 10.0  # client timeout [s], long enough for a busy machine
_MOTIONS = ("press", "turn")
_QUERY_INTERVAL = 0.1  # interval at which a client asks for the remaining time of a motion [s]


class FolderError(SoftfingerError):
    """Unusable folder. The error message states the reason and a remedy."""


class LinkFolder:
    """Folder that an emulator locks and fills with links to its ptys.

    The user must own the folder, and other users must not have write access. Links that a killed
    emulator left behind are replaced. Other files are never replaced.
    """

    def __init__(self, path: Path) -> None:
        """Create and lock the folder. Raises FolderError if the folder is in use or unusable."""
        self.path = path
        self._targets: dict[str, str] = {}  # target of each link
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            require_own(path)
            self._lock = self._take(path / _LOCK)
        except OSError as error:
            reason = error.strerror or error
            raise FolderError(f"{path}: can't be used as --dir: {reason}") from None
        for name in LINKS:
            link = path / name
            if link.exists() and not link.is_symlink():
                self.close()
                raise FolderError(f"{link}: exists but is not a link; move it elsewhere")

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
                    "stop that emulator or choose a different --dir"
                ) from None
            # The previous emulator may have removed the lock file after this process opened it.
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_ino == os.fstat(lock).st_ino:
                    os.ftruncate(lock, 0)
                    os.write(lock, f"{os.getpid()}\n".encode())
                    return lock
            os.close(lock)

    def link(self, name: str, target: str) -> None:
        """Create or replace the link ``name`` to ``target`` atomically."""
        link = self.path / name
        # Without an atomic replacement, a client could find no port while the link is replaced.
        fresh = self.path / f".{name}.{os.getpid()}"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target)
        fresh.replace(link)
        self._targets[name] = target

    def unlink(self, name: str) -> None:
        """Remove the link ``name``, unless its target has changed."""
        target = self._targets.pop(name, "")
        with contextlib.suppress(OSError):
            if str((self.path / name).readlink()) == target:
                (self.path / name).unlink()

    def close(self) -> None:
        """Remove the lock and all links whose targets have not changed."""
        for name in list(self._targets):
            self.unlink(name)
        with contextlib.suppress(OSError):
            (self.path / _LOCK).unlink()
        with contextlib.suppress(OSError):
            os.close(self._lock)


def find_ports(folder: Path) -> dict[str, Path]:
    """Return the names and paths of the port links in ``folder``."""
    return {name: folder / name for name in LINKS if (folder / name).is_symlink()}


class NoEmulator(SoftfingerError):
    """No emulator is running in the folder, or the emulator does not respond."""


class ControlPort:
    """Control socket ``folder``/control. The function ``handle`` returns the reply to a message.

    The owner of ``selector`` must call ``key.data`` for each key that becomes readable.
    """

    def __init__(
        self, folder: Path, handle: Callable[[str], str], selector: selectors.BaseSelector
    ) -> None:
        """Bind the socket.

        Raises FolderError if ``folder``/control exists but is not a socket.
        """
        self._handle = handle
        self._selector = selector
        self._folder = os.open(folder, _DIRECTORY)
        self._clients: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            with contextlib.suppress(FileNotFoundError):
                # This process holds the folder lock, so any existing socket was left by a killed
                # emulator.
                if not stat.S_ISSOCK(os.stat(_CONTROL, dir_fd=self._folder).st_mode):
                    raise FolderError(f"{folder / _CONTROL}: already exists; move it elsewhere")
                os.unlink(_CONTROL, dir_fd=self._folder)
            self._listener.bind(_address(self._folder))
            self._listener.listen(_CLIENT_COUNT_MAX)
            self._listener.setblocking(False)
            selector.register(self._listener, selectors.EVENT_READ, self._accept)
        except BaseException:
            self._listener.close()
            os.close(self._folder)
            raise

    def close(self) -> None:
        """Disconnect all clients and remove the socket."""
        for each in (self._listener, *self._clients):
            each.close()
        with contextlib.suppress(OSError):
            os.unlink(_CONTROL, dir_fd=self._folder)
        os.close(self._folder)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._clients.append(client)
            answer = partial(self._answer, client)
            self._selector.register(client, selectors.EVENT_READ, answer)
            if len(self._clients) > _CLIENT_COUNT_MAX:
                self._hang_up(self._clients[0])

    def _answer(self, client: socket.socket) -> None:
        try:
            data = client.recv(_MESSAGE_SIZE_MAX)
            if data:
                client.send(self._handle(data.decode("utf-8", "replace")).encode())
                return
        except OSError:
            pass
        self._hang_up(client)

    def _hang_up(self, client: socket.socket) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client)
            client.close()


def carry_out(folder: Path, text: str) -> str:
    """Send ``text`` to the emulator in ``folder``; return the reply when all motions have ended.

    The result is empty unless the text requests a report.

    Raises
    ------
    NoEmulator
        If no emulator is running in the folder, or if the emulator does not reply.
    Refused
        If the emulator rejects the text; the message lists the expected words.
    """
    reply = send_words(folder, text)
    # The hand's clock stops while the emulator is suspended, so query the remaining time again
    # after each wait.
    kind = text.partition(" ")[0]
    while kind in _MOTIONS and reply.startswith("{"):
        left = json.loads(reply)["wait"]
        if left == 0.0:
            return ""
        time.sleep(min(left, _QUERY_INTERVAL))
        reply = send_words(folder, kind)
    if reply.startswith("error: "):
        raise Refused(reply.removeprefix("error: "), Reason.REQUEST)
    return "" if reply == "ok" else reply


def send_words(folder: Path, text: str) -> str:
    """Send ``text`` to the emulator in ``folder`` and return the emulator's reply.

    Raises
    ------
    NoEmulator
        If no emulator is running in the folder, or if the emulator does not reply.
    Refused
        If the text is too long. The emulator would read only its beginning.
    """
    message = text.encode(errors="replace")
    if len(message) > _MESSAGE_SIZE_MAX:
        problem = f"found {len(message)} bytes, expected at most {_MESSAGE_SIZE_MAX}"
        raise Refused(f"{problem}: send fewer words at a time", Reason.REQUEST)
    try:
        with contextlib.ExitStack() as opened:
            descriptor = os.open(folder, _DIRECTORY)
            opened.callback(os.close, descriptor)
            client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            opened.enter_context(client)
            client.settimeout(_CLIENT_TIMEOUT)
            client.connect(_address(descriptor))
            client.send(message)
            reply = client.recv(_REPLY_SIZE_MAX)
    except OSError:
        raise NoEmulator(f"{folder}: no emulator is running here") from None
    if not reply:
        raise NoEmulator(f"{folder}: the emulator has exited")
    return reply.decode()


def _address(folder: int) -> str:
    """Return a socket address that contains the folder's descriptor instead of its path.

    The path of the folder could exceed the maximum length of a socket address.
    """
    return f"/proc/self/fd/{folder}/{_CONTROL}"
