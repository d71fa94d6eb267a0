"""Connections of clients without keys: accepted, read and answered within bounds of our own.

One that breaks the protocol or a bound is hung up on. Where there is no place for one that comes,
one that has not shaken hands goes, or of the commanders the one that has been silent longest.
"""

from __future__ import annotations

import select
import socket
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from softfinger.daemon.gateway.admission import Pace, Requests
from softfinger.daemon.gateway.config import Topics
from softfinger.daemon.gateway.poll import Poll
from softfinger.daemon.gateway.zmtp import GREETING, Broken, Parser, frame, pong, ready, socket_type
from softfinger.daemon.wire.sockets import Listener

_HANDSHAKE = 2.0  # s in which a peer has to have shown what it is
_ACCEPTED = 32  # connections at a look
_READ = 512  # bytes of one peer at a look
_REST = 0.05  # s in which one that floods is not read
_REST_EACH = 5e-4  # s, and longer by this for each other one
_REPLIES = 256 * 1024  # bytes of replies that a client leaves unread
_PARTS = 2  # of a request: REQ's empty one and the request
_PINGS = 4  # of a commander at a read
_SUBSCRIPTIONS = 64.0  # changes of a subscriber at once, …
_SUBSCRIPTION_RATE = 10.0  # … and a second
_SUBSCRIPTION = 64  # bytes
_BACKLOG = 32 << 20  # bytes that wait for all subscribers, before the slowest is hung up on
_VECTOR = 64  # messages in one call


class Peer:
    """One connection, from its acceptance on."""

    KIND: ClassVar[bytes]  # our socket's type
    TAKES: ClassVar[frozenset[bytes]]  # and the peer's

    def __init__(self, door: Any, connection: socket.socket, limit: int, epoch: int) -> None:
        self._door = door
        self.socket = connection
        self.fd = connection.fileno()
        self.epoch = epoch
        self.alive = True
        self.ready = False
        self.resting = False
        self._parser = Parser(limit)
        self._out: deque[bytes | memoryview] = deque()
        self._waiting = 0  # bytes in it
        self.send(GREETING)

    def read(self, now: float) -> None:
        """Take in some of what came."""
        try:
            data = self.socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._door.hang_up(self)
            return
        try:
            for command, more, body in self._parser.feed(data):
                if command:
                    self._command(body, now)
                elif not self.ready:
                    raise Broken("a message before the handshake")
                else:
                    self._part(body, more, now)
                if not self.alive:
                    return
        except Broken:
            self._door.hang_up(self)
            return
        if len(data) < _READ:
            self._emptied()

    def _command(self, body: bytes, now: float) -> None:
        if not self.ready:
            if socket_type(body) not in self.TAKES:
                raise Broken("a socket of another type")
            self.ready = True
            self.send(ready(self.KIND))
            self._door.shaken(self)
        elif body.startswith(b"\x04PING"):
            self.send(pong(body))

    def _part(self, body: bytes, more: bool, now: float) -> None:
        raise NotImplementedError

    def _emptied(self) -> None:
        """Nothing is left in the connection that came before now, but for a part of a message."""
        if self._parser.empty:
            self.epoch = self._door.epoch

    def freshen(self) -> None:
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
        if not self._out:
            try:
                sent = self.socket.send(data)
            except BlockingIOError:
                sent = 0
            except OSError:
                self._door.hang_up(self)
                return
            if sent == len(data):
                return
            self._out.append(memoryview(data)[sent:] if sent else data)
            self._keep(len(data) - sent)
            self._door.interest(self)
        else:
            self._out.append(data)
            self._keep(len(data))

    def _keep(self, size: int) -> None:
        self._waiting += size
        if self._waiting > _REPLIES:
            self._door.hang_up(self)

    def flush(self) -> None:
        """Send what waits, now that there is room."""
        try:
            while self._out:
                parts = [self._out[k] for k in range(min(len(self._out), _VECTOR))]
                sent = self.socket.sendmsg(parts)
                self._sent(sent)
                while sent:
                    part = self._out.popleft()
                    if sent < len(part):
                        self._out.appendleft(memoryview(part)[sent:])
                        return
                    sent -= len(part)
        except BlockingIOError:
            return
        except OSError:
            self._door.hang_up(self)
            return
        self._door.interest(self)

    def _sent(self, size: int) -> None:
        self._waiting -= size

    @property
    def events(self) -> int:
        """What is waited for."""
        return (0 if self.resting else select.EPOLLIN) | (select.EPOLLOUT if self._out else 0)


class Commander(Peer):
    """A client's connection for requests."""

    KIND = b"ROUTER"
    TAKES = frozenset({b"REQ", b"DEALER"})

    name = ""

    def __init__(
        self, door: Any, connection: socket.socket, limit: int, epoch: int, pace: Pace
    ) -> None:
        self.pace = pace
        self._parts: list[bytes] = []
        self._pings = 0  # at this read
        super().__init__(door, connection, limit, epoch)

    def read(self, now: float) -> None:
        self.pace.begin_read()
        self._pings = 0
        super().read(now)

    def _command(self, body: bytes, now: float) -> None:
        self._pings += 1
        if self._pings > _PINGS:
            raise Broken("too many pings")
        super()._command(body, now)

    def _part(self, body: bytes, more: bool, now: float) -> None:
        self._parts.append(body)
        if more:
            if len(self._parts) >= _PARTS:
                raise Broken("a request of too many parts")
            return
        *envelope, payload = self._parts
        self._parts = []
        self._door.take(self, b"".join(frame(part, more=True) for part in envelope), payload, now)

    def _emptied(self) -> None:
        self.pace.behind = False
        if not self._parts:
            super()._emptied()

    def answer(self, envelope: bytes, reply: bytes) -> None:
        """Send a reply, in the form of its request."""
        if self.alive:
            self.send(envelope + frame(reply))


class Subscriber(Peer):
    """A client's connection for the stream."""

    KIND = b"PUB"
    TAKES = frozenset({b"SUB", b"XSUB"})

    def __init__(
        self, door: Stream, connection: socket.socket, limit: int, epoch: int, queue: int
    ) -> None:
        self._prefixes: set[bytes] = set()
        self.mask = 0  # topics as bits
        self._queue = queue
        self._may = _SUBSCRIPTIONS
        self._then = 0.0
        self._stream = door
        super().__init__(door, connection, limit, epoch)

    def _command(self, body: bytes, now: float) -> None:
        self._count(now)
        if self.ready and body[:10] == b"\x09SUBSCRIBE":
            self._change(body[10:], True)
        elif self.ready and body[:7] == b"\x06CANCEL":
            self._change(body[7:], False)
        else:
            super()._command(body, now)

    def _part(self, body: bytes, more: bool, now: float) -> None:
        self._count(now)
        if more:
            raise Broken("a subscription of parts")
        if body[:1] in (b"\0", b"\1"):  # anything else is an XSUB's own message
            self._change(body[1:], body[:1] == b"\1")

    def _count(self, now: float) -> None:
        """One more of whatever it sends."""
        self._may = min(self._may + (now - self._then) * _SUBSCRIPTION_RATE, _SUBSCRIPTIONS) - 1.0
        self._then = now
        if self._may < 0.0:
            raise Broken("too many subscriptions")

    def _change(self, prefix: bytes, subscribe: bool) -> None:
        topics = self._stream.matching(prefix)
        if not topics:
            return  # the beginning of no topic of ours: there may be any number of it
        if subscribe:
            self._prefixes.add(prefix)
        else:
            self._prefixes.discard(prefix)
        before, self.mask = self.mask, 0
        for each in self._prefixes:
            self.mask |= self._stream.matching(each)
        if self.mask != before:
            self._stream.subscribed(self, before)

    @property
    def backlog(self) -> int:
        """Bytes that wait for it."""
        return self._waiting

    def publish(self, message: bytes) -> None:
        """One message, which is dropped when too many wait."""
        if len(self._out) < self._queue:
            self.send(message)

    def _keep(self, size: int) -> None:
        self._waiting += size
        self._stream.backlog += size

    def _sent(self, size: int) -> None:
        self._waiting -= size
        self._stream.backlog -= size


class Door:
    """A listening socket and the connections that came through it."""

    def __init__(self, listener: Listener, poll: Poll, limit: int, places: int) -> None:
        """``limit`` bounds a frame [bytes], ``places`` the connections."""
        self._listener = listener
        self._poll = poll
        self._limit = limit
        self._places = places
        self._peers: dict[int, Peer] = {}  # by descriptor; those first that were silent longest
        self._shaking: dict[Peer, float] = {}  # until when, in the order they came
        self._resting: deque[tuple[float, Peer]] = deque()
        self._older = 0  # that wait to be accepted, and came before the present epoch
        self.begun = 0  # the epoch of who comes in from now on; none from before waits any more
        self.epoch = 0
        self.now = 0.0
        poll.watch(listener.fileno(), select.EPOLLIN, lambda _: self.accept())

    def _make(self, connection: socket.socket, epoch: int) -> Peer:
        raise NotImplementedError

    def _goes(self) -> Peer | None:
        """Who leaves so that another may come; None: nobody."""
        return next(iter(self._shaking), None)

    def _begin(self) -> None:
        self._older = 0
        self.begun = self.epoch

    def accept(self) -> None:
        """Take in connections that wait."""
        for _ in range(_ACCEPTED):
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                self._begin()
                return
            except OSError:  # it has gone already, or the system has no descriptor left
                return
            epoch = self.begun
            if self._older:
                self._older -= 1
                if not self._older:
                    self._begin()
            if len(self._peers) >= self._places:
                leaving = self._goes()
                if leaving is None:
                    connection.close()
                    continue
                self.hang_up(leaving)
            connection.setblocking(False)
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer = self._make(connection, epoch)
            if peer.alive:
                self._peers[peer.fd] = peer
                self._shaking[peer] = self.now + _HANDSHAKE
                self._poll.watch(peer.fd, peer.events, partial(self._act, peer))

    def _act(self, peer: Peer, events: int) -> None:
        if not peer.alive:
            return
        if events & select.EPOLLOUT:
            peer.flush()
        if peer.alive and events & ~select.EPOLLOUT:
            peer.read(self.now)

    def shaken(self, peer: Peer) -> None:
        """A peer has shown what it is."""
        self._shaking.pop(peer, None)

    def interest(self, peer: Peer) -> None:
        """What is waited for has changed."""
        if peer.fd in self._peers:
            self._poll.change(peer.fd, peer.events)

    def hang_up(self, peer: Peer) -> None:
        """End a connection."""
        if not peer.alive:
            return
        peer.alive = False
        if self._peers.pop(peer.fd, None) is not None:
            self._poll.forget(peer.fd)
        self._shaking.pop(peer, None)
        peer.socket.close()

    def tend(self) -> None:
        """What is due by the time: handshakes that took too long, and who has rested."""
        if self.begun != self.epoch:
            self.accept()
        while self._shaking:
            peer, until = next(iter(self._shaking.items()))
            if until > self.now:
                break
            self.hang_up(peer)
        while self._resting and self._resting[0][0] <= self.now:
            _, peer = self._resting.popleft()
            peer.resting = False
            if peer.alive:
                self.interest(peer)

    def begin_epoch(self, epoch: int) -> None:
        """Who has nothing waiting is in it; the others once all of that has been read."""
        self.epoch = epoch
        self._older = self._listener.waiting()
        if not self._older:
            self._begin()
        self.accept()
        for peer in list(self._peers.values()):
            peer.freshen()

    def close(self) -> None:
        """Hang up on all."""
        self._poll.forget(self._listener.fileno())
        self._listener.close()
        for peer in list(self._peers.values()):
            self.hang_up(peer)


class Commands(Door):
    """Where requests come in."""

    def __init__(
        self, listener: Listener, poll: Poll, limit: int, places: int, requests: Requests
    ) -> None:
        self._requests = requests
        super().__init__(listener, poll, limit, places)

    def _make(self, connection: socket.socket, epoch: int) -> Peer:
        pace = self._requests.new_pace(self.now)
        return Commander(self, connection, self._limit, epoch, pace)

    def _goes(self) -> Peer | None:
        return super()._goes() or next(iter(self._peers.values()), None)

    def take(self, peer: Commander, envelope: bytes, payload: bytes, now: float) -> None:
        """One request."""
        self._peers[peer.fd] = self._peers.pop(peer.fd)  # it was heard of last
        self._requests.take(peer, envelope, payload, now)

    def _act(self, peer: Peer, events: int) -> None:
        super()._act(peer, events)
        if isinstance(peer, Commander) and peer.alive and peer.pace.tired and not peer.resting:
            peer.resting = True
            self._resting.append((self.now + max(_REST, _REST_EACH * len(self._resting)), peer))
            self.interest(peer)


class Stream(Door):
    """Where subscribers come in."""

    def __init__(
        self,
        listener: Listener,
        poll: Poll,
        places: int,
        queue: int,
        topics: Topics,
        late: Callable[[int], list[tuple[int, bytes]]],
    ) -> None:
        """``queue`` messages wait for one subscriber; ``late`` gives what one that comes late to
        these topics (as bits) is told.
        """
        self._topics = tuple(name.encode() for name in topics.names)
        self._matching: dict[bytes, int] = {}  # all that may be subscribed to: topics as bits
        for k, topic in enumerate(self._topics):
            for length in range(len(topic) + 1):
                prefix = topic[:length]
                self._matching[prefix] = self._matching.get(prefix, 0) | 1 << k
        self._readers = [0] * len(self._topics)  # of each topic
        self._queue = queue
        self._late = late
        self.backlog = 0  # bytes that wait for all of them
        self.wanted = 0  # topics as bits
        super().__init__(listener, poll, _SUBSCRIPTION, places)

    def _make(self, connection: socket.socket, epoch: int) -> Peer:
        return Subscriber(self, connection, self._limit, epoch, self._queue)

    def _goes(self) -> Peer | None:
        idle = (p for p in self._peers.values() if isinstance(p, Subscriber) and not p.mask)
        return super()._goes() or next(idle, None)

    def matching(self, prefix: bytes) -> int:
        """The topics that begin so, as bits."""
        return self._matching.get(prefix, 0)

    def subscribed(self, peer: Subscriber, before: int) -> None:
        """A subscriber wants other topics now than ``before``, as bits."""
        self._count(before, peer.mask)
        new = peer.mask & ~before
        late = self._late(new)
        if late:
            peer.publish(b"".join(self._on_wire(topic, message) for topic, message in late))

    def _count(self, before: int, now: int) -> None:
        for k in range(len(self._topics)):
            self._readers[k] += (now >> k & 1) - (before >> k & 1)
        self.wanted = sum(1 << k for k, readers in enumerate(self._readers) if readers)

    def publish(self, topic: int, message: bytes) -> None:
        """One message to all who want its topic."""
        bit = 1 << topic
        wire = self._on_wire(topic, message)
        for peer in list(self._peers.values()):
            if isinstance(peer, Subscriber) and peer.mask & bit:
                peer.publish(wire)
        while self.backlog > _BACKLOG:
            slowest = max(
                (p for p in self._peers.values() if isinstance(p, Subscriber)),
                key=lambda p: p.backlog,
            )
            self.hang_up(slowest)

    def _on_wire(self, topic: int, message: bytes) -> bytes:
        return frame(self._topics[topic], more=True) + frame(message)

    def hang_up(self, peer: Peer) -> None:
        if peer.alive and isinstance(peer, Subscriber):
            self.backlog -= peer.backlog
            self._count(peer.mask, 0)
        super().hang_up(peer)
