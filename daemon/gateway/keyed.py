"""Clients with keys: libzmq's sockets, and pyzmq's authenticator.

Nobody gets past the handshake without a key, and libzmq bounds what comes before. Its own thread
reads ahead of us, so what arrived before a stop is known by time alone: for a moment after it all
requests are refused, and its own answer waits as long.
"""

from __future__ import annotations

import select
import time
from collections import OrderedDict
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import zmq
import zmq.utils.z85
from zmq.auth.thread import ThreadAuthenticator

from softfinger.daemon.errors import KeyFileError, NoDescriptor
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import Endpoint, StartAnew
from softfinger.daemon.gateway.request_queue import Pace
from softfinger.daemon.gateway.server import Server
from softfinger.daemon.wire.keys import DOMAIN, ServerKeys, load_server
from softfinger.daemon.wire.sockets import IpcFile, bind_error

_NOW = int(zmq.NOBLOCK)
_READ = 64  # subscriptions read at a time
_PARTS = bounds.PARTS + 1  # and the client's number


class Keys(ThreadAuthenticator):
    """Knows the clients' keys, as the folder has them now."""

    def __init__(self, context: zmq.Context[Any], folder: Path) -> None:
        super().__init__(context)
        self._folder = folder
        self._at = 0.0
        self.server: ServerKeys = load_server(folder)
        self.start()
        self.configure_curve_callback(DOMAIN.decode(), self)

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client with this key is let in; asked by the authenticator."""
        return domain == DOMAIN.decode() and key in self.server.clients

    def curve_user_id(self, client_public_key: bytes) -> str:
        """The key's name."""
        return self.server.clients.get(zmq.utils.z85.encode(client_public_key), "")

    def look(self, now: float) -> None:
        """Let in who was added to the folder. Raises StartAnew when somebody was taken away."""
        if now < self._at:
            return
        self._at = now + bounds.KEYS_CHECKED
        try:
            try:
                found = load_server(self._folder)
            except NoDescriptor:  # strangers hold them all: nobody is let in who was not before
                found = self.server.left(self._folder)
        except KeyFileError as error:
            raise StartAnew(str(error)) from None
        gone = [name for key, name in self.server.clients.items() if key not in found.clients]
        if gone or found.secret != self.server.secret:
            raise StartAnew(f"access.keys: shut out: {', '.join(gone) or 'all clients'}")
        self.server = found


class _Client:
    """One connection, as libzmq numbers them."""

    alive = True

    def __init__(self, endpoint: KeyedCommands, route: bytes, name: str, pace: Pace) -> None:
        self._endpoint = endpoint
        self._route = route
        self.name = name
        self.pace = pace

    @property
    def epoch(self) -> int:
        return self._endpoint.begun

    def answer(self, envelope: list[bytes], reply: bytes) -> None:
        self._endpoint.answer([self._route, *envelope, reply])


class _KeyedEndpoint(Endpoint):
    """A bound socket. libzmq signals a change once, so all of it is read."""

    def __init__(
        self, server: Server, keys: Keys, config: Config, kind: int, queue: int, limit: int
    ) -> None:
        """``queue`` messages of ``limit`` bytes wait for one client. Raises AddressError."""
        self._keys = keys
        self._poller = server.poller
        self._file: IpcFile | None = None
        key, address = config.stream_key, config.stream
        if kind == zmq.ROUTER:
            key, address = "commands.address", config.commands
        if address.startswith("ipc://"):
            self._file = IpcFile(address, key, config.ipc_mode)
        self._socket: zmq.Socket[Any] = keys.context.socket(kind)
        self._socket.setsockopt(zmq.LINGER, int(1e3 * bounds.LAST_WORDS))
        # These bounds hold only for connections made after they were set, so before bind.
        self._socket.setsockopt(zmq.MAXMSGSIZE, limit)
        self._socket.setsockopt(zmq.SNDHWM, queue)
        self._socket.setsockopt(zmq.RCVHWM, queue)
        keys.server.guard(self._socket)
        try:
            with self._file.coming_into_being() if self._file else nullcontext():
                self._socket.bind(address)
        except (zmq.ZMQError, OSError) as error:
            self._socket.close()
            raise bind_error(address, key, error.errno, str(error)) from None
        self._fd = cast(int, self._socket.getsockopt(zmq.FD))
        self._poller.watch(self._fd, select.EPOLLIN, lambda _: self.tend())

    def _parts(self) -> list[zmq.Frame] | None:
        """The next message's first few parts; None when there is none."""
        found: list[zmq.Frame] = []
        try:
            while not found or found[-1].more:
                part = self._socket.recv(_NOW, copy=False)
                found[_PARTS:] = [part]
        except zmq.Again:
            return None
        return found

    def close(self) -> None:
        self._poller.forget(self._fd)
        self._socket.close()
        if self._file is not None:
            self._file.close()


class KeyedCommands(_KeyedEndpoint):
    """Where requests come in."""

    def __init__(self, server: Server, keys: Keys, config: Config) -> None:
        """Raises AddressError."""
        self._requests = server.requests
        self._clients: OrderedDict[bytes, _Client] = OrderedDict()
        self._passed_at = 0.0  # when the last one did
        self._empty = True  # at the last look
        self._replies: list[list[bytes]] = []  # held back since …
        self._held_since = 0.0
        limit = bounds.FRAMES * config.max_bytes
        super().__init__(server, keys, config, zmq.ROUTER, bounds.KEYED_QUEUE, limit)

    def tend(self) -> None:
        self._keys.look(self.now)
        if self.begun != self.epoch:
            if self._is_purged():
                self.begun = self.epoch
                self._answer_held()
            elif self._replies and time.monotonic() - self._held_since > bounds.LONGEST_PURGE:
                self._answer_held()  # others stop without pause: what comes next is refused, too
        self._empty = False
        seen = set()
        until = time.monotonic() + bounds.TURN
        while time.monotonic() < until:
            parts = self._parts()
            if parts is None:
                self._empty = True
                break
            route, *envelope, payload = (part.bytes for part in parts)
            if len(envelope) <= 1 and route:
                client = self._client(route, str(parts[-1].get("User-Id")))
                if client not in seen:
                    seen.add(client)
                    client.pace.begin_read()
                    client.pace.behind = False
                self._requests.take(client, envelope, payload, self.now)

    def _is_purged(self) -> bool:
        past = time.monotonic() - self._passed_at
        return past > bounds.PURGE and (self._empty or past > bounds.LONGEST_PURGE)

    def _answer_held(self) -> None:
        replies, self._replies = self._replies, []
        for reply in replies:
            self._send(reply)

    def _client(self, route: bytes, name: str) -> _Client:
        client = self._clients.get(route)
        if client is None:
            client = _Client(self, route, name, self._requests.new_pace(self.now))
            self._clients[route] = client
            if len(self._clients) > bounds.KEYED_CLIENTS:
                self._clients.popitem(last=False)
        return client

    def answer(self, message: list[bytes]) -> None:
        """Send a reply, once what came before a stop has been refused."""
        if self.begun == self.epoch:
            self._send(message)
            return
        if not self._replies:
            self._held_since = time.monotonic()
        self._replies.append(message)

    def _send(self, message: list[bytes]) -> None:
        try:
            self._socket.send_multipart(message, _NOW)
        except zmq.ZMQError:
            pass  # the client has gone

    def begin_epoch(self, epoch: int) -> None:
        """It begins in a moment."""
        self.epoch = epoch
        self._passed_at = time.monotonic()


class KeyedStream(_KeyedEndpoint):
    """Where subscribers come in."""

    def __init__(self, server: Server, keys: Keys, config: Config) -> None:
        """Raises AddressError."""
        self._names = tuple(name.encode() for name in config.topics.names)
        self._matching = config.topics.matching
        self._late = server.repeated.late
        self._prefixes: set[bytes] = set()
        super().__init__(server, keys, config, zmq.XPUB, config.queue, bounds.KEYED_SUBSCRIPTION)
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # reports each subscriber of a topic

    def tend(self) -> None:
        self._keys.look(self.now)
        late = 0
        for _ in range(_READ):
            parts = self._parts()
            if parts is None:
                break
            change = parts[0].bytes
            matching = self._matching(change[1:])
            if change[:1] == b"\1" and matching:
                self._prefixes.add(change[1:])
                late |= matching
            elif change[:1] == b"\0":
                self._prefixes.discard(change[1:])
        self.wanted = self._matching(*self._prefixes)
        for topic, message in self._late(late) if late else ():
            self.publish(topic, message)

    def begin_epoch(self, epoch: int) -> None:
        self.epoch = self.begun = epoch

    def publish(self, topic: int, message: bytes) -> None:
        """One message to all who want its topic; a slow one's is dropped."""
        self._socket.send(self._names[topic], _NOW | zmq.SNDMORE)
        self._socket.send(message, _NOW)


def open_endpoints(server: Server, config: Config) -> None:
    """Bind what ``config`` names, for the clients whose keys are in its folder.

    Raises AddressError and KeyFileError.
    """
    keys = Keys(zmq.Context(), Path(config.keys))
    if config.stream:
        server.add(KeyedStream(server, keys, config))
    if config.commands:
        server.add(KeyedCommands(server, keys, config))
