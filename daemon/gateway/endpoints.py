"""Provide the client sockets and authenticate the clients.

Without keys all clients are accepted, but libzmq disconnects peers that do not send a ZMTP 3
greeting. The greeting excludes web pages, whose POST requests are valid messages in older protocol
versions.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections import deque
from pathlib import Path
from typing import Any

import zmq
import zmq.utils.z85
from zmq.auth.thread import ThreadAuthenticator

from softfinger.daemon.errors import AddressError, KeyFileError, NoDescriptor, SoftfingerError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.wire.keys import ServerKeys, load_server
from softfinger.daemon.wire.loop_link import repeated

NO_WAIT = int(zmq.NOBLOCK)
IN_USE = "is in use; is another softfinger running?"
_DOMAIN = "softfinger"


class RestartNeeded(SoftfingerError):
    """All clients must be disconnected so that they reconnect. The message gives the reason."""


class Admission(ThreadAuthenticator):
    """Authenticate clients for libzmq with the keys that are currently in the folder."""

    def __init__(self, context: zmq.Context[Any], folder: Path | None) -> None:
        """Load the keys in ``folder`` (see `softfinger keys`).

        If ``folder`` is None, all clients are accepted.

        Raises
        ------
        KeyFileError
            If the keys can't be read.
        """
        super().__init__(context)
        self._folder = folder
        self._keys: ServerKeys | None = None if folder is None else load_server(folder)
        self._look_at = 0.0
        self.start()
        if folder is not None:
            self.configure_curve_callback(_DOMAIN, self)

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Restrict a socket to authenticated clients. Call this method before bind."""
        if self._keys is not None:
            self._keys.guard(socket)
        # With these options, libzmq rejects every client if the authenticator fails.
        socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        socket.setsockopt(zmq.HANDSHAKE_IVL, int(1e3 * bounds.HANDSHAKE_TIMEOUT))

    def callback(self, domain: str, key: bytes) -> bool:
        """Return True if the client with this key is accepted. Called by the authenticator."""
        return self._keys is not None and domain == _DOMAIN and key in self._keys.clients

    def curve_user_id(self, client_public_key: bytes) -> str:
        """Return the name of the client that has this key."""
        assert self._keys is not None
        return self._keys.clients.get(zmq.utils.z85.encode(client_public_key), "")

    def name(self, part: zmq.Frame) -> str:
        """Return the sender's name according to its key, or an empty string without keys."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def look(self, now: float) -> None:
        """Check the key folder and accept newly added clients.

        Raises
        ------
        RestartNeeded
            If a key was removed or the authenticator has ended.
        """
        if now < self._look_at:
            return
        self._look_at = now + bounds.KEY_CHECK_INTERVAL
        if not self.is_alive():
            raise RestartNeeded("the thread that authenticates clients has ended")
        if self._folder is None or self._keys is None:
            return
        try:
            try:
                found = load_server(self._folder)
            except NoDescriptor:  # All file descriptors are in use, so new keys can't be read.
                found = self._keys.left(self._folder)
        except KeyFileError as error:
            raise RestartNeeded(str(error)) from None
        gone = [name for key, name in self._keys.clients.items() if key not in found.clients]
        if gone or found.secret != self._keys.secret:
            raise RestartNeeded(
                "access.keys: disconnected the clients that have no key file: "
                f"{', '.join(gone) or 'all'}"
            )
        self._keys = found


def bind(bound: zmq.Socket[Any], address: str, ipc_mode: int) -> str:
    """Bind a socket and return its file path, or an empty string for TCP. Raises AddressError."""
    path = address.removeprefix("ipc://") if address.startswith("ipc://") else ""
    if path and (trouble := _taken(path)):
        raise AddressError(f"{address} {trouble}")
    bound.setsockopt(zmq.IPV6, int("[" in address))
    before = os.umask(0o777 & ~ipc_mode)  # The socket file must never have wider permissions.
    try:
        # libzmq binds only to numeric addresses.
        bound.bind(address.replace("tcp://localhost:", "tcp://127.0.0.1:"))
        if path:
            Path(path).chmod(ipc_mode)
    except (zmq.ZMQError, OSError) as error:
        if error.errno == errno.EADDRINUSE:
            raise AddressError(f"{address} {IN_USE}") from None
        raise AddressError(f"can't bind {address}: {error.strerror}") from None
    finally:
        os.umask(before)
    return path


def _taken(path: str) -> str:
    """Return the reason why a socket can't replace ``path``, or an empty string if it can."""
    if not Path(path).exists():
        return ""
    if not Path(path).is_socket():
        return "exists but is not a socket"
    with socket.socket(socket.AF_UNIX) as trial:
        trial.setblocking(False)
        try:
            trial.connect(path)
        except (FileNotFoundError, ConnectionRefusedError):  # A killed process left the file.
            return ""
        except OSError:  # The socket's queue is full, or this user lacks permission.
            pass
    return IN_USE


class Endpoint:
    """Bound socket with the gateway's limits."""

    def __init__(
        self, admission: Admission, kind: int, address: str, key: str, config: Config, limit: int
    ) -> None:
        """Bind a socket; ``key`` names its address setting, ``limit`` is the size per message part.

        Raises
        ------
        AddressError
            If the address can't be bound.
        """
        self.socket: zmq.Socket[Any] = admission.context.socket(kind)
        # Socket options apply only to later connections, so they must be set before bind.
        self.socket.setsockopt(zmq.LINGER, int(1e3 * bounds.LINGER_TIME))
        self.socket.setsockopt(zmq.MAXMSGSIZE, limit)
        self.socket.setsockopt(
            zmq.SNDHWM, bounds.SOCKET_QUEUE_LENGTH if kind == zmq.ROUTER else config.queue
        )
        self.socket.setsockopt(zmq.RCVHWM, bounds.SOCKET_QUEUE_LENGTH)
        admission.guard(self.socket)
        try:
            self._path = bind(self.socket, address, config.ipc_mode)
        except AddressError as error:
            self.socket.close()
            raise AddressError(f"{key}: {error}") from None

    def _parts(self) -> list[zmq.Frame]:
        """Return the next message's parts, but at most one part more than allowed.

        Empty without message.
        """
        found: list[zmq.Frame] = []
        with contextlib.suppress(zmq.Again):
            while not found or found[-1].more:
                found[bounds.PART_COUNT_MAX :] = [self.socket.recv(NO_WAIT, copy=False)]
        return found

    def close(self) -> None:
        self.socket.close()
        if self._path:
            with contextlib.suppress(OSError):
                Path(self._path).unlink()


class StreamEndpoint(Endpoint):
    """Socket that publishes the stream to subscribers."""

    def __init__(self, admission: Admission, config: Config) -> None:
        """Bind the socket. Raises AddressError."""
        self._topics = [name.encode() for name in config.topics]
        self._prefixes: set[bytes] = set()
        self._kept: dict[int, deque[bytes]] = {}  # each topic's last messages, for late subscribers
        self._came_late = 0  # bit mask of topics to repeat for late subscribers
        self._tell_at = 0.0  # earliest time of the next repetition
        self.wanted = 0  # bit mask of topics with subscribers
        super().__init__(
            *(
                admission,
                zmq.XPUB,
                config.stream,
                config.stream_key,
                config,
                bounds.SUBSCRIPTION_SIZE_MAX,
            )
        )
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # report every subscription to a topic

    def read(self, now: float) -> None:
        """Read subscriptions, and send stored messages to new subscribers."""
        for _ in range(bounds.SUBSCRIPTIONS_PER_TURN):
            parts = self._parts()
            if not parts:
                break
            change = parts[0].bytes
            matching = self._matching(change[1:])
            if change[:1] == b"\1" and matching:
                self._prefixes.add(change[1:])
                self._came_late |= matching
            elif change[:1] == b"\0":
                self._prefixes.discard(change[1:])
        self.wanted = self._matching(*self._prefixes)
        if self._came_late and now >= self._tell_at:
            for topic, kept in self._kept.items():
                for message in kept if self._came_late >> topic & 1 else ():
                    self._send(topic, message)
            self._came_late = 0
            self._tell_at = now + bounds.REPEAT_INTERVAL

    def _matching(self, *prefixes: bytes) -> int:
        """Return a bit mask of the topics that begin with any of the prefixes."""
        return sum(1 << k for k, name in enumerate(self._topics) if name.startswith(prefixes))

    def publish(self, topic: int, keep: int, message: bytes) -> None:
        """Send a message; store the topic's last ``keep`` messages for late subscribers."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(repeated(message))
        self._send(topic, message)

    def _send(self, topic: int, message: bytes) -> None:
        """Send one message to all subscribers of its topic. Slow subscribers miss it."""
        self.socket.send_multipart((self._topics[topic], message), NO_WAIT)
