"""The two addresses where clients come in: a ROUTER for commands, an XPUB for the stream.

libzmq's own thread reads ahead of us, so what arrived before a stop is known by time alone. After
it all requests are refused for a moment, and on while they come thicker than clients may send them,
as those do that have waited. The stop's own answer waits as long, within a bound. If the socket was
not polled for more than `bounds.GAP`, requests that are then found are dated by the poll before.

Without keys everybody is let in, but libzmq hangs up on all who don't greet it as ZMTP 3 does: web
pages among them, whose POST older versions take for messages.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import socket
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq
import zmq.utils.z85
from zmq.auth.thread import ThreadAuthenticator

from softfinger.daemon.errors import AddressError, KeyFileError, NoDescriptor, SoftfingerError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.request_queue import Client, RequestQueue
from softfinger.daemon.wire.keys import ServerKeys, load_server

_NOW = int(zmq.NOBLOCK)
_PARTS = bounds.PARTS + 1  # and the client's route
_DOMAIN = "softfinger"
IN_USE = "is in use; is another softfinger running?"

Late = Callable[[int], list[tuple[int, bytes]]]


class StartAnew(SoftfingerError):
    """All connections are to end, and clients to come in again. The message says why."""


class Admission(ThreadAuthenticator):
    """Asked by libzmq about each client. Knows the keys as the folder has them now."""

    def __init__(self, context: zmq.Context[Any], folder: Path | None) -> None:
        """``folder`` is of `softfinger keys`, None to let everybody in. Raises KeyFileError."""
        super().__init__(context)
        self._folder = folder
        self._keys: ServerKeys | None = None if folder is None else load_server(folder)
        self._look_at = 0.0
        self.start()
        if folder is not None:
            self.configure_curve_callback(_DOMAIN, self)

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Before bind: only whom this lets in."""
        if self._keys is not None:
            self._keys.guard(socket)
        # Without an authenticator nobody is let in, rather than everybody.
        socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        socket.setsockopt(zmq.HANDSHAKE_IVL, int(1e3 * bounds.HANDSHAKE))

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client with this key is let in; asked by the authenticator."""
        return self._keys is not None and domain == _DOMAIN and key in self._keys.clients

    def curve_user_id(self, client_public_key: bytes) -> str:
        """Return the key's name."""
        assert self._keys is not None
        return self._keys.clients.get(zmq.utils.z85.encode(client_public_key), "")

    def name(self, part: zmq.Frame) -> str:
        """Return who sent this, by the key; empty without keys."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def look(self, now: float) -> None:
        """Let in who was added to the folder. Raises StartAnew when somebody was taken away."""
        if now < self._look_at:
            return
        self._look_at = now + bounds.KEYS_CHECKED
        if not self.is_alive():
            raise StartAnew("the authenticator has ended")
        if self._folder is None or self._keys is None:
            return
        try:
            try:
                found = load_server(self._folder)
            except NoDescriptor:  # strangers hold them all: nobody is let in who was not before
                found = self._keys.left(self._folder)
        except KeyFileError as error:
            raise StartAnew(str(error)) from None
        gone = [name for key, name in self._keys.clients.items() if key not in found.clients]
        if gone or found.secret != self._keys.secret:
            raise StartAnew(f"access.keys: shut out: {', '.join(gone) or 'all clients'}")
        self._keys = found


def bind(bound: zmq.Socket[Any], address: str, ipc_mode: int) -> str:
    """Bind a socket; return its file, empty where there is none. Raises AddressError."""
    path = address.removeprefix("ipc://") if address.startswith("ipc://") else ""
    if path and (trouble := _taken(path)):
        raise AddressError(f"{address} {trouble}")
    bound.setsockopt(zmq.IPV6, int("[" in address))
    before = os.umask(0o777 & ~ipc_mode)  # its rights from the first: nobody slips in before
    try:
        # libzmq binds numbers alone.
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
    """Return why a socket may not take the place of ``path``; empty if it may."""
    if not Path(path).exists():
        return ""
    if not Path(path).is_socket():
        return "is there already and is no socket"
    with socket.socket(socket.AF_UNIX) as trial:
        trial.setblocking(False)
        try:
            trial.connect(path)
        except (FileNotFoundError, ConnectionRefusedError):  # of a process that was killed
            return ""
        except OSError:  # it takes nobody more, or not us
            pass
    return IN_USE


class Endpoint:
    """A bound socket."""

    def __init__(
        self, admission: Admission, kind: int, address: str, key: str, config: Config, limit: int
    ) -> None:
        """``key`` is the setting that names the address, ``limit`` bounds a message's part.

        Raises AddressError.
        """
        self.socket: zmq.Socket[Any] = admission.context.socket(kind)
        # These hold only for connections made after they were set, so before bind.
        self.socket.setsockopt(zmq.LINGER, int(1e3 * bounds.LAST_WORDS))
        self.socket.setsockopt(zmq.MAXMSGSIZE, limit)
        queue = config.queue if kind == zmq.XPUB else bounds.QUEUE
        self.socket.setsockopt(zmq.SNDHWM, queue)
        self.socket.setsockopt(zmq.RCVHWM, bounds.QUEUE)
        admission.guard(self.socket)
        try:
            self._path = bind(self.socket, address, config.ipc_mode)
        except BaseException as error:
            self.socket.close()
            if isinstance(error, AddressError):
                raise AddressError(f"{key}: {error}") from None
            raise

    def _parts(self) -> list[zmq.Frame] | None:
        """The next message's first few parts; None when there is none."""
        found: list[zmq.Frame] = []
        try:
            while not found or found[-1].more:
                found[_PARTS:] = [self.socket.recv(_NOW, copy=False)]
        except zmq.Again:
            return None
        return found

    def close(self) -> None:
        self.socket.close()
        if self._path:
            with contextlib.suppress(OSError):
                Path(self._path).unlink()


class CommandEndpoint(Endpoint):
    """The socket by which requests come in and answers go out.

    After a fence it reads what may have come before; `past` is the time from when on all that
    comes came after it.
    """

    def __init__(
        self,
        admission: Admission,
        config: Config,
        requests: RequestQueue,
        clock: Callable[[], float],
    ) -> None:
        """Raises AddressError."""
        self._clock = clock
        self._admission = admission
        self._requests = requests
        self._clients: OrderedDict[bytes, Client] = OrderedDict()
        self.past = -math.inf
        self._looked = clock()  # time of the last poll; nothing came before the socket was bound
        # Time of the last poll before a gap; None once all requests from the gap have been read.
        self._gap_began: float | None = None
        self._gap_ended = 0.0
        self._gap_left = 0  # requests that may still be from the gap
        self._since = 0.0  # a fence was raised, or last looked at; since then …
        self._came = 0  # … so many requests came that change something
        self._replies: list[list[bytes]] = []  # held back until the fence is passed
        self._held = 0.0  # s, of which each step counts PURGE at most: a stall doesn't use it up
        limit = bounds.FRAMES * config.max_bytes
        super().__init__(admission, zmq.ROUTER, config.commands, "commands.address", config, limit)

    def raise_fence(self) -> None:
        """Refuse what has arrived until now: it takes a moment to read that."""
        self.past = self._requests.past = math.inf
        self._since = self._clock()
        self._came = 0

    def read(self) -> None:
        """Take in requests, for as long as others may wait."""
        began = self._clock()
        if began - self._looked > bounds.GAP:
            if self._gap_began is None:
                self._gap_began = self._looked
            self._gap_ended = began
            self._gap_left = bounds.CLIENTS * bounds.QUEUE
        self._held += min(began - self._looked, bounds.PURGE)
        self._looked = began
        if self.past < math.inf or self._held > bounds.LONGEST_HELD:
            self._answer_held()
        while (now := self._clock()) < began + bounds.TURN:
            parts = self._parts()
            if parts is None:
                self._has_read_all(now)
                return
            *route, payload = (part.bytes for part in parts)
            self._came += b"status" not in payload
            self._gap_left -= 1
            if self._gap_left < 0:  # more than can have waited
                self._gap_began = None
            if len(route) < _PARTS:
                came = now if self._gap_began is None else self._gap_began
                client = self._client(route[0], self._admission.name(parts[-1]), now)
                self._requests.take(client, route, payload, now, came)

    def _has_read_all(self, now: float) -> None:
        """Note that nothing waits: perhaps all has been read that came before a gap or a fence.

        libzmq's thread may still hand on a message. So both take `PURGE` without a further gap.
        """
        if now - self._gap_ended > bounds.PURGE:
            self._gap_began = None
        if self.past == math.inf and now - self._since > bounds.PURGE:
            if self._gap_began is None and self._came <= bounds.ALL_RATE * bounds.PURGE:
                self.past = self._requests.past = now
            self._since = now
            self._came = 0

    def _client(self, identity: bytes, name: str, now: float) -> Client:
        client = self._clients.get(identity)
        if client is None:
            client = self._clients[identity] = self._requests.new_client(name, now)
            if len(self._clients) > bounds.CLIENTS:
                self._clients.popitem(last=False)
        return client

    def answer(self, route: list[bytes], reply: bytes) -> None:
        """Send a reply, once what came before a fence has been read."""
        message = [*route, reply]
        if self.past < math.inf:
            self._send(message)
            return
        if not self._replies:
            self._held = 0.0
        self._replies.append(message)

    def _answer_held(self) -> None:
        replies, self._replies = self._replies, []
        for reply in replies:
            self._send(reply)

    def _send(self, message: list[bytes]) -> None:
        try:
            self.socket.send_multipart(message, _NOW)
        except zmq.ZMQError:
            pass  # the client has gone


class StreamEndpoint(Endpoint):
    """The socket of the subscribers."""

    def __init__(self, admission: Admission, config: Config, late: Late) -> None:
        """``late`` gives what late subscribers to these topics (as bits) are told.

        Raises AddressError.
        """
        self._names = tuple(name.encode() for name in config.topics.names)
        self._matching = config.topics.matching
        self._late = late
        self._prefixes: set[bytes] = set()
        self._came_late = 0  # topics that are to be told again, as bits …
        self._tell_at = 0.0  # … then
        self.wanted = 0  # topics that somebody subscribes to, as bits
        limit = bounds.SUBSCRIPTION
        super().__init__(admission, zmq.XPUB, config.stream, config.stream_key, config, limit)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # reports each subscriber of a topic

    def read(self, now: float) -> None:
        """Learn who came and went; tell all again what those who came have missed."""
        for _ in range(bounds.SUBSCRIPTIONS):
            parts = self._parts()
            if parts is None:
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
            for topic, message in self._late(self._came_late):
                self.publish(topic, message)
            self._came_late = 0
            self._tell_at = now + bounds.TELL_AGAIN

    def publish(self, topic: int, message: bytes) -> None:
        """One message to all who want its topic; a slow one's is dropped."""
        self.socket.send_multipart((self._names[topic], message), _NOW)
