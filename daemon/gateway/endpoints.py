"""Open the client sockets, authenticate the clients and publish the stream.

Without keys, all clients are accepted, but libzmq disconnects peers that do not send a ZMTP 3
greeting. The required greeting excludes web pages, because their POST requests are valid messages
only in older protocol versions.
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

from softfinger.daemon.errors import AddressError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.own_files import IN_USE, free_socket_path
from softfinger.daemon.wire.keys import load_server
from softfinger.daemon.wire.loop_link import repeated

NO_WAIT = int(zmq.NOBLOCK)
_LATEST_TOPIC = 0  # index of the topic that is also published in single-frame messages


class ClientSockets:
    """Sockets that enforce the gateway's limits and admit only clients with a stored key."""

    def __init__(self, config: bounds.Config) -> None:
        """Load the keys; if there is no key folder, accept all clients. Raises KeyFileError."""
        self._config = config
        self._keys = load_server(Path(config.keys)) if config.keys else None
        self._check_at = 0.0  # time of the next check of the key folder
        self._paths: list[str] = []  # files of ipc sockets
        self._context: zmq.Context[Any] = zmq.Context()
        self.handshakes = self._context.socket(zmq.REP)
        self.handshakes.bind("inproc://zeromq.zap.01")  # ZeroMQ Authentication Protocol, RFC 27

    def open(self, kind: int, address: str, setting: str) -> zmq.Socket[Any]:
        """Open a socket and bind it, unless the address is empty.

        Raises AddressError, whose message contains ``setting``.
        """
        config, is_router = self._config, kind == zmq.ROUTER
        part_size = bounds.SUBSCRIPTION_SIZE_MAX
        if is_router:
            part_size = max(part_size, bounds.PART_SIZE_RATIO * config.max_bytes)
        opened: zmq.Socket[Any] = self._context.socket(kind)
        # Set the options before binding, because an option affects only later connections.
        for option, value in (
            (zmq.MAXMSGSIZE, part_size),
            (zmq.SNDHWM, bounds.SOCKET_QUEUE_LENGTH if is_router else config.queue),
            (zmq.RCVHWM, bounds.SOCKET_QUEUE_LENGTH),
            (zmq.HANDSHAKE_IVL, int(1e3 * bounds.HANDSHAKE_TIMEOUT)),
            (zmq.ZAP_DOMAIN, b"softfinger"),
            (zmq.ZAP_ENFORCE_DOMAIN, 1),  # reject every client that is not authenticated
        ):
            opened.setsockopt(option, value)
        if self._keys is not None:
            self._keys.guard(opened)
        if address:
            try:
                self._paths.append(bind(opened, address, config.ipc_mode))
            except AddressError as error:
                raise AddressError(f"{setting}: {error}") from None
        return opened

    def authenticate(self, now: float) -> None:
        """Accept or reject new clients. Raises KeyFileError if a key was removed or is unusable."""
        if self._keys is not None and now >= self._check_at:
            self._check_at = now + bounds.KEY_CHECK_INTERVAL
            self._keys = self._keys.updated()
        with contextlib.suppress(zmq.Again):
            for _ in range(bounds.HANDSHAKES_PER_TURN):
                version, number, _, _, _, _, *key = self.handshakes.recv_multipart(NO_WAIT)
                names = {b"": ""} if self._keys is None else self._keys.clients
                name = names.get(zmq.utils.z85.encode(b"".join(key)))
                status, user = (b"400", "") if name is None else (b"200", name)
                self.handshakes.send_multipart([version, number, status, b"", user.encode(), b""])

    def name(self, part: zmq.Frame) -> str:
        """Return the client name that belongs to the sender's key, or "" if no keys are used."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def close(self) -> None:
        """Send queued messages for up to `bounds.LINGER_TIME`, then disconnect all clients."""
        self._context.destroy(linger=int(1e3 * bounds.LINGER_TIME))
        for path in filter(None, self._paths):
            Path(path).unlink(missing_ok=True)


def bind(bound: zmq.Socket[Any], address: str, ipc_mode: int) -> str:
    """Bind a socket and return its file path, or an empty string for TCP. Raises AddressError."""
    path = address.removeprefix("ipc://") if address.startswith("ipc://") else ""
    bound.setsockopt(zmq.IPV6, int("[" in address))
    before = os.umask(0o777 & ~ipc_mode)
    try:
        if path and (taken := free_socket_path(Path(path), socket.SOCK_STREAM)):
            raise AddressError(f"{address} {taken}")  # libzmq would replace an existing file.
        # libzmq binds only to numeric addresses.
        bound.bind(address.replace("tcp://localhost:", "tcp://127.0.0.1:"))
    except (zmq.ZMQError, OSError) as error:
        if error.errno == errno.EADDRINUSE:
            raise AddressError(f"{address} {IN_USE}") from None
        raise AddressError(f"can't bind {address}: {error.strerror}") from None
    finally:
        os.umask(before)
    return path


def read_parts(source: zmq.Socket[Any]) -> list[zmq.Frame]:
    """Read the next message and return at most `bounds.PART_COUNT_MAX` + 1 of its parts.

    Returns an empty list if there is no message.
    """
    found: list[zmq.Frame] = []
    with contextlib.suppress(zmq.Again):
        while not found or found[-1].more:
            found[bounds.PART_COUNT_MAX :] = [source.recv(NO_WAIT, copy=False)]
    return found


class StreamEndpoint:
    """Sockets that publish the stream to subscribers. Slow subscribers miss messages."""

    def __init__(self, sockets: ClientSockets, config: bounds.Config) -> None:
        """Bind the sockets. Raises AddressError."""
        self.socket = sockets.open(zmq.XPUB, config.stream, config.stream_setting)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # also report repeated subscriptions
        self._latest = sockets.open(zmq.PUB, config.latest, "stream.latest")
        self._always_wanted = bool(config.latest) << _LATEST_TOPIC
        self._topics = [name.encode() for name in config.topics]
        self._prefixes: set[bytes] = set()
        self._kept: dict[int, deque[bytes]] = {}  # each topic's last messages, for late subscribers
        self._came_late = 0  # bit mask of topics to be resent to late subscribers
        self._repeat_at = 0.0  # earliest time of the next repetition

    def read(self, now: float) -> int:
        """Read subscriptions, and send stored messages to new subscribers.

        Returns a bit mask of the topics that have subscribers.
        """
        for _ in range(bounds.SUBSCRIPTIONS_PER_TURN):
            parts = read_parts(self.socket)
            if not parts:
                break
            kind, prefix = parts[0].bytes[:1], parts[0].bytes[1:]
            matching = self._matching(prefix)
            if kind == b"\1" and matching:
                self._prefixes.add(prefix)
                self._came_late |= matching
            elif kind == b"\0":
                self._prefixes.discard(prefix)
        if self._came_late and now >= self._repeat_at:
            for topic, kept in self._kept.items():
                for message in kept if self._came_late >> topic & 1 else ():
                    self.publish(topic, 0, message)
            self._came_late = 0
            self._repeat_at = now + bounds.REPEAT_INTERVAL
        return self._matching(*self._prefixes) | self._always_wanted

    def _matching(self, *prefixes: bytes) -> int:
        """Return a bit mask of the topics that begin with any of the prefixes."""
        return sum(1 << k for k, name in enumerate(self._topics) if name.startswith(prefixes))

    def publish(self, topic: int, keep: int, message: bytes) -> None:
        """Send a message; store the topic's last ``keep`` messages for late subscribers."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append(repeated(message))
        self.socket.send_multipart((self._topics[topic], message), NO_WAIT)
        if self._always_wanted >> topic & 1:
            self._latest.send(message, NO_WAIT)
