"""Connections of clients without keys, each read and answered within bounds.

One that breaks the protocol or a bound is disconnected.
"""

from __future__ import annotations

import math
import select
import socket
from collections import deque
from itertools import islice
from typing import Any, ClassVar

from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.request_queue import Allowance, Pace
from softfinger.daemon.gateway.zmtp import (
    GREETING,
    Broken,
    FrameParser,
    frame,
    pong,
    ready,
    socket_type,
)

_VECTOR = 64  # messages in one call


class Connection:
    """One connection, from its acceptance on."""

    TYPE: ClassVar[bytes]  # our socket's type
    PARTNERS: ClassVar[frozenset[bytes]]  # and the client's
    MOST_WAITING: ClassVar[float] = math.inf  # bytes that it may leave unread

    tired = False  # it floods: it is not to be read for a while
    topics = 0  # that it subscribes to, as bits

    def __init__(self, endpoint: Any, accepted: socket.socket, epoch: int) -> None:
        """``endpoint`` is one of `gateway.endpoints`."""
        self._endpoint = endpoint
        self.socket = accepted
        self.fd = accepted.fileno()
        self.epoch = epoch
        self.alive = True
        self.ready = False  # the handshake is over
        self.resting = False
        self.waiting = 0  # bytes that it has not taken yet
        self._parser = FrameParser(endpoint.limit)
        self._controls = Allowance(bounds.CONTROLS)
        self._out: deque[memoryview] = deque()
        self.send(GREETING)

    def read(self, now: float) -> None:
        """Take in some of what came."""
        try:
            data = self.socket.recv(bounds.READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._endpoint.disconnect(self)
            return
        try:
            for control, more, body in self._parser.feed(data):
                if control:
                    self._count(now)
                    self._control(body)
                elif not self.ready:
                    raise Broken("a message before the handshake")
                else:
                    self._part(body, more, now)
                if not self.alive:
                    return
        except Broken:
            self._endpoint.disconnect(self)
            return
        if len(data) < bounds.READ:
            self._emptied()

    def _count(self, now: float) -> None:
        if not self._controls.take(bounds.CONTROL_RATE, bounds.CONTROLS, now):
            raise Broken("too many subscriptions or pings")

    def _control(self, body: bytes) -> None:
        """One command of the protocol."""
        if not self.ready:
            if socket_type(body) not in self.PARTNERS:
                raise Broken("a socket of another type")
            self.ready = True
            self.send(ready(self.TYPE))
            self._endpoint.finished_handshake(self)
        elif body.startswith(b"\x04PING"):
            self.send(pong(body))

    def _part(self, body: bytes, more: bool, now: float) -> None:
        """One part of a message."""
        raise NotImplementedError

    def _emptied(self) -> None:
        """Nothing is left in the connection that came before now, but for a part of a message."""
        if self._parser.empty:
            self.epoch = self._endpoint.epoch

    def join_epoch(self) -> None:
        """An epoch begins: this connection is in it if nothing waits in it."""
        if self._parser.empty:
            try:
                self.socket.recv(1, socket.MSG_PEEK)
            except BlockingIOError:
                self._emptied()
            except OSError:
                pass

    def send(self, data: bytes) -> None:
        """Send, or keep what finds no room."""
        sent = 0
        if not self._out:
            try:
                sent = self.socket.send(data)
            except BlockingIOError:
                pass
            except OSError:
                self._endpoint.disconnect(self)
                return
        if sent == len(data):
            return
        self._out.append(memoryview(data)[sent:])
        self.waiting += len(data) - sent
        if self.waiting > self.MOST_WAITING:
            self._endpoint.disconnect(self)
        elif len(self._out) == 1:
            self._endpoint.watch(self)

    def flush(self) -> None:
        """Send what waits, now that there is room."""
        try:
            while self._out:
                sent = self.socket.sendmsg(list(islice(self._out, _VECTOR)))
                self.waiting -= sent
                while sent:
                    part = self._out.popleft()
                    if sent < len(part):
                        self._out.appendleft(part[sent:])
                        return
                    sent -= len(part)
        except BlockingIOError:
            return
        except OSError:
            self._endpoint.disconnect(self)
            return
        self._endpoint.watch(self)

    @property
    def events(self) -> int:
        """What is waited for, as epoll's bits."""
        return (0 if self.resting else select.EPOLLIN) | (select.EPOLLOUT if self._out else 0)


class CommandConnection(Connection):
    """A client's connection for requests."""

    TYPE = b"ROUTER"
    PARTNERS = frozenset({b"REQ", b"DEALER"})
    MOST_WAITING = bounds.REPLIES

    name = ""  # clients without keys have none

    def __init__(self, endpoint: Any, accepted: socket.socket, epoch: int) -> None:
        self.pace: Pace = endpoint.requests.new_pace(endpoint.now)
        self._parts: list[bytes] = []
        super().__init__(endpoint, accepted, epoch)

    def read(self, now: float) -> None:
        self.pace.begin_read()
        super().read(now)
        self.tired = self.pace.tired

    def _part(self, body: bytes, more: bool, now: float) -> None:
        self._parts.append(body)
        if more:
            if len(self._parts) >= bounds.PARTS:
                raise Broken("a request of too many parts")
            return
        *envelope, payload = self._parts
        self._parts = []
        self._endpoint.take(self, b"".join(frame(part, more=True) for part in envelope), payload)

    def _emptied(self) -> None:
        self.pace.behind = False
        if not self._parts:
            super()._emptied()

    def answer(self, envelope: bytes, reply: bytes) -> None:
        """Send a reply, in the form of its request."""
        if self.alive:
            self.send(envelope + frame(reply))


class StreamConnection(Connection):
    """A client's connection for the stream."""

    TYPE = b"PUB"
    PARTNERS = frozenset({b"SUB", b"XSUB"})

    def __init__(self, endpoint: Any, accepted: socket.socket, epoch: int) -> None:
        self._prefixes: set[bytes] = set()
        super().__init__(endpoint, accepted, epoch)

    def _control(self, body: bytes) -> None:
        if self.ready and body[:10] == b"\x09SUBSCRIBE":
            self._change(body[10:], True)
        elif self.ready and body[:7] == b"\x06CANCEL":
            self._change(body[7:], False)
        else:
            super()._control(body)

    def _part(self, body: bytes, more: bool, now: float) -> None:
        self._count(now)
        if more:
            raise Broken("a subscription of parts")
        if body[:1] in (b"\0", b"\1"):  # anything else is an XSUB's own message
            self._change(body[1:], body[:1] == b"\1")

    def _change(self, prefix: bytes, subscribe: bool) -> None:
        if not self._endpoint.matching(prefix):
            return  # the beginning of no topic of ours: there may be any number of it
        if subscribe:
            self._prefixes.add(prefix)
        else:
            self._prefixes.discard(prefix)
        before, self.topics = self.topics, self._endpoint.matching(*self._prefixes)
        if self.topics != before:
            self._endpoint.subscribed(self, before)

    def publish(self, message: bytes) -> None:
        """One message, which is dropped when too many wait."""
        if len(self._out) < self._endpoint.queue:
            self.send(message)
