"""Manage CurveZMQ key files and socket options for the daemon and its clients.

The server and the clients each have their own key pair. A client needs the server's public key. The
server needs the public keys of its clients and rejects all other clients. `make_keys` creates a
folder with these files:

``server/server.key_secret``, ``server/server.key``
    the daemon's key pair, and a file that contains only its public key
``server/clients/NAME.key``
    an accepted client's public key; removing the file disconnects that client
``NAME/server.key``, ``NAME/client.key_secret``
    the files to copy to the client's machine; the client ``local`` is for this machine

The files are ZeroMQ certificates, which other ZeroMQ programs can also read. Files and folders that
another user owns or may write to are refused, because this user could add a key. All parent folders
are checked in the same way.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
import zmq.auth
import zmq.utils.z85

from softfinger.daemon.errors import KeyFileError
from softfinger.kinematics.compiled.own_folder import check_above, fault

LOCAL = "local"  # name of the local client, which every key folder contains

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_LENGTH = 32  # length of a key [bytes]


class _NoDescriptor(KeyFileError):
    """Failure to read keys because too many files are open. The keys themselves may be valid."""


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """The daemon's key pair and the public keys of its clients, encoded in Z85."""

    folder: Path
    public: bytes
    secret: bytes
    clients: dict[bytes, str]  # maps each public key to a client name

    def updated(self) -> ServerKeys:
        """Read the keys again.

        Raises KeyFileError if the keys can't be read, or if a key was removed whose clients must be
        disconnected. Removed files are also detected if no file descriptor is free.
        """
        clients = self.folder / "clients"
        with _reported(clients):
            check_above(clients / "any")
            known = self.clients.values()
            gone = {name for name in known if not (clients / f"{name}.key").exists()}
        found = self
        with contextlib.suppress(_NoDescriptor):
            found = load_server(self.folder)
        gone |= {name for key, name in self.clients.items() if key not in found.clients}
        if gone or found.secret != self.secret:
            names = ", ".join(sorted(gone)) or "all"
            raise KeyFileError(f"access.keys: disconnected clients without a key file: {names}")
        return found

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Make a socket accept only clients with known keys. Call this method before `bind`."""
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.secret)
        socket.setsockopt(zmq.CURVE_PUBLICKEY, self.public)


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """A client's key pair and the server's public key, encoded in Z85."""

    server: bytes
    public: bytes
    secret: bytes

    def guard(self, socket: zmq.Socket[Any] | zmq.Context[Any]) -> None:
        """Use these keys for an unconnected socket, or for all new sockets of a context."""
        socket.setsockopt(zmq.CURVE_SERVERKEY, self.server)
        socket.setsockopt(zmq.CURVE_PUBLICKEY, self.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.secret)


def check_curve() -> None:
    """Raise KeyFileError if the installed libzmq does not support CURVE."""
    if not zmq.has("curve"):
        raise KeyFileError(
            f"libzmq {zmq.zmq_version()} was built without CURVE: install a published pyzmq "
            "wheel, or use only addresses on this machine"
        )


def make_keys(folder: Path, names: list[str]) -> list[Path]:
    """Create a key pair for each client, and for the server if it does not have one yet.

    Returns
    -------
    list[Path]
        The new folders.

    Raises
    ------
    KeyFileError
        If a file can't be written or a client already exists. In both cases, no new files remain.
    """
    check_curve()
    server = folder / "server"
    new = not (server / "server.key_secret").exists()
    wanted = [LOCAL, *names] if new else names
    for name in wanted:
        if not _NAME.fullmatch(name) or name == "server":
            raise KeyFileError(
                f"{name!r} is not a valid client name: expected at most 64 letters, digits, dots "
                "and dashes"
            )
        there = [server / "clients" / f"{name}.key", folder / name]
        if any(path.exists() for path in there) or wanted.count(name) > 1:
            raise KeyFileError(f"{folder}: the client {name} already exists; choose another name")
    if not wanted:
        raise KeyFileError(
            f"{folder}: the server's keys already exist; to add clients, give their names"
        )
    before = os.umask(0o077)
    made: list[Path] = []
    try:
        (server / "clients").mkdir(parents=True, exist_ok=True)
        check_above(server / "clients" / "any")
        if new:
            made += server / "server.key", server / "server.key_secret"
            zmq.auth.create_certificates(server, "server")
        for name in wanted:
            client = folder / name
            client.mkdir()
            made += client, server / "clients" / f"{name}.key"
            zmq.auth.create_certificates(client, "client")
            shutil.copyfile(server / "server.key", client / "server.key")
            # Move the public key last, so that the server accepts only clients that have all their
            # keys.
            (client / "client.key").rename(server / "clients" / f"{name}.key")
    except OSError as error:
        for path in made:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        text = f"{error.filename or folder}: {error.strerror}" if error.errno else str(error)
        raise KeyFileError(text) from None
    finally:
        os.umask(before)
    return [folder / name for name in (["server", *wanted] if new else wanted)]


def load_server(folder: Path) -> ServerKeys:
    """Load the daemon's keys from a `make_keys` folder or its ``server`` subfolder.

    Raises KeyFileError.
    """
    check_curve()
    place = folder if (folder / "server.key_secret").exists() else folder / "server"
    public, secret = _pair(place / "server.key_secret")
    clients = place / "clients"
    with _reported(clients):
        check_above(clients / "any")
        paths = [path for path in sorted(clients.iterdir()) if path.suffix == ".key"]
        names = {_keys(path)[0]: path.stem for path in paths}
    if not names:
        raise KeyFileError(
            f"{clients}: the folder does not contain client keys; create keys with "
            "`softfinger keys`"
        )
    return ServerKeys(place, public, secret, names)


def load_client(folder: Path) -> ClientKeys:
    """Load the keys of a client from its folder, or of the local client from a `make_keys` folder.

    Raises KeyFileError.
    """
    check_curve()
    place = folder if (folder / "client.key_secret").exists() else folder / LOCAL
    public, secret = _pair(place / "client.key_secret")
    return ClientKeys(_keys(place / "server.key")[0], public, secret)


@contextlib.contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Convert system errors and failed checks of the folders to KeyFileError."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # raised by `check_above`
            raise KeyFileError(str(error)) from None
        kind = _NoDescriptor if error.errno in (errno.EMFILE, errno.ENFILE) else KeyFileError
        missing = isinstance(error, FileNotFoundError)
        remedy = "create key files with `softfinger keys`" if missing else "make it readable"
        raise kind(f"{path}: can't be read: {error.strerror}; {remedy}") from None


def _pair(path: Path) -> tuple[bytes, bytes]:
    with _reported(path):
        check_above(path)
    public, secret = _keys(path, secret=True)
    if secret is None:
        raise KeyFileError(f"{path}: the file does not contain a secret key")
    return public, secret


def _keys(path: Path, secret: bool = False) -> tuple[bytes, bytes | None]:
    """Read a key file.

    Raises KeyFileError if another user owns the file, may write to it, or may read a secret key.
    """
    with _reported(path):
        status = path.stat()
        mode = stat.S_IMODE(status.st_mode)
        if secret and mode & 0o077:
            raise KeyFileError(
                f"{path}: other users can read this file ({mode:04o}); run chmod 600 {path}"
            )
        if wrong := fault(path, status):
            raise KeyFileError(wrong)
        try:
            keys = zmq.auth.load_certificate(path)
            lengths = {len(zmq.utils.z85.decode(key)) for key in filter(None, keys)}
        except (ValueError, LookupError, struct.error):  # struct.error: outside the Z85 range
            lengths = set()
        if lengths != {_LENGTH}:
            raise KeyFileError(f"{path}: not a key file")
    return keys
