"""The addresses where clients without keys come in: their connections, accepted within bounds.

Where there is no place for one that comes, one that has not finished its handshake leaves, or of
the commanders the one that has been silent longest.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.connections import CommandConnection, Connection, StreamConnection
from softfinger.daemon.gateway.request_queue import RequestQueue
from softfinger.daemon.gateway.zmtp import frame
from softfinger.daemon.wire.loop_link import Topics
from softfinger.daemon.wire.sockets import Listener

_Connection = TypeVar("_Connection", bound=Connection)
Late = Callable[[int], list[tuple[int, bytes]]]

_READY = 64  # descriptors asked for at once


class Poller:
    """Waits for descriptors and calls what each was given."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._calls: dict[int, Callable[[int], None]] = {}
        self._due: deque[tuple[int, int, Callable[[int], None]]] = deque()

    def watch(self, fd: int, events: int, call: Callable[[int], None]) -> None:
        """Call ``call`` with what happened, whenever something does."""
        self._calls[fd] = call
        self._epoll.register(fd, events)

    def change(self, fd: int, events: int) -> None:
        self._epoll.modify(fd, events)

    def forget(self, fd: int) -> None:
        del self._calls[fd]
        self._epoll.unregister(fd)

    def step(self, seconds: float, most: float) -> None:
        """Wait for ``seconds`` at most, and call for ``most`` s; the rest is called next time."""
        if not self._due:
            for fd, events in self._epoll.poll(seconds, _READY):
                self._due.append((fd, events, self._calls[fd]))
        until = time.monotonic() + most
        while self._due:
            fd, events, call = self._due.popleft()
            if self._calls.get(fd) is call:  # else it was forgotten meanwhile
                call(events)
            if time.monotonic() > until:
                return

    def close(self) -> None:
        self._epoll.close()


class StartAnew(SoftfingerError):
    """All connections are to end, and clients to come in again. The message says why."""


class Endpoint:
    """An address where clients come in. ``now`` is the server's time [s].

    ``epoch`` is the newest, ``begun`` that of requests which come from now on: the newest once
    nothing can come any more that arrived before it.
    """

    now = 0.0
    epoch = 0
    begun = 0
    wanted = 0  # topics that somebody subscribes to, as bits

    @property
    def backlog(self) -> int:
        """Bytes that wait for subscribers."""
        return 0

    def publish(self, topic: int, message: bytes) -> None:
        """One message to all who want its topic."""

    def tend(self) -> None:
        """Do what is due by the time."""

    def begin_epoch(self, epoch: int) -> None:
        """Requests that arrived before are not to be given this epoch."""
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class PlainEndpoint(Endpoint, Generic[_Connection]):
    """A listening socket and its connections."""

    CONNECTION: type[_Connection]

    def __init__(self, listener: Listener, poller: Poller, limit: int, places: int) -> None:
        """``limit`` bounds a frame [bytes], ``places`` the connections."""
        self._listener = listener
        self._poller = poller
        self.limit = limit
        self._places = places
        self._connections: dict[int, _Connection] = {}  # those first that were silent longest
        self._handshakes: dict[Connection, float] = {}  # until when, in the order they came
        self._resting: deque[tuple[float, Connection]] = deque()
        self._older = 0  # that wait to be accepted, and came before the present epoch
        poller.watch(listener.fileno(), select.EPOLLIN, lambda _: self.accept())

    def _leaves(self) -> Connection | None:
        """Who leaves so that another may come; None: nobody."""
        return next(iter(self._handshakes), None)

    def _begin(self) -> None:
        self._older = 0
        self.begun = self.epoch

    def accept(self) -> None:
        """Take in connections that wait."""
        for _ in range(bounds.ACCEPTED):
            try:
                accepted, _ = self._listener.accept()
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
            if len(self._connections) >= self._places:
                leaving = self._leaves()
                if leaving is None:
                    accepted.close()
                    continue
                self.disconnect(leaving)
            accepted.setblocking(False)
            if accepted.family != socket.AF_UNIX:
                accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = self.CONNECTION(self, accepted, epoch)
            if connection.alive:
                self._connections[connection.fd] = connection
                self._handshakes[connection] = self.now + bounds.HANDSHAKE
                serve = partial(self._serve, connection)
                self._poller.watch(connection.fd, connection.events, serve)

    def _serve(self, connection: Connection, events: int) -> None:
        if events & select.EPOLLOUT and connection.alive:
            connection.flush()
        if events & ~select.EPOLLOUT and connection.alive:
            connection.read(self.now)
        if connection.alive and connection.tired and not connection.resting:
            connection.resting = True
            rest = max(bounds.REST, bounds.REST_EACH * len(self._resting))
            self._resting.append((self.now + rest, connection))
            self.watch(connection)

    def finished_handshake(self, connection: Connection) -> None:
        """It need not leave for another any more."""
        self._handshakes.pop(connection, None)

    def watch(self, connection: Connection) -> None:
        """What a connection waits for has changed."""
        if self._connections.get(connection.fd) is connection:
            self._poller.change(connection.fd, connection.events)

    def disconnect(self, connection: Connection) -> None:
        if not connection.alive:
            return
        connection.alive = False
        if self._connections.pop(connection.fd, None) is not None:
            self._poller.forget(connection.fd)
        self._handshakes.pop(connection, None)
        connection.socket.close()

    def tend(self) -> None:
        """End handshakes that took too long, and rests."""
        if self.begun != self.epoch:
            self.accept()
        while self._handshakes:
            connection, until = next(iter(self._handshakes.items()))
            if until > self.now:
                break
            self.disconnect(connection)
        while self._resting and self._resting[0][0] <= self.now:
            _, connection = self._resting.popleft()
            connection.resting = False
            self.watch(connection)

    def begin_epoch(self, epoch: int) -> None:
        """Who has nothing waiting is in it; the others once all of that has been read."""
        self.epoch = epoch
        self._older = self._listener.waiting()
        if not self._older:
            self._begin()
        self.accept()
        for connection in list(self._connections.values()):
            connection.join_epoch()

    def close(self) -> None:
        self._poller.forget(self._listener.fileno())
        self._listener.close()
        for connection in list(self._connections.values()):
            self.disconnect(connection)


class CommandEndpoint(PlainEndpoint[CommandConnection]):
    """Where requests come in."""

    CONNECTION = CommandConnection

    def __init__(
        self, listener: Listener, poller: Poller, limit: int, places: int, requests: RequestQueue
    ) -> None:
        self.requests = requests
        super().__init__(listener, poller, limit, places)

    def _leaves(self) -> Connection | None:
        return super()._leaves() or next(iter(self._connections.values()), None)

    def take(self, connection: CommandConnection, envelope: bytes, payload: bytes) -> None:
        fd = connection.fd
        self._connections[fd] = self._connections.pop(fd)  # it was silent for the shortest time
        self.requests.take(connection, envelope, payload, self.now)


class StreamEndpoint(PlainEndpoint[StreamConnection]):
    """Where subscribers come in."""

    CONNECTION = StreamConnection

    def __init__(
        self,
        listener: Listener,
        poller: Poller,
        places: int,
        queue: int,
        topics: Topics,
        late: Late,
    ) -> None:
        """``queue`` messages wait for one subscriber.

        ``late`` gives what a late subscriber to these topics (as bits) gets.
        """
        self._names = tuple(name.encode() for name in topics.names)
        self.matching = topics.matching
        self.queue = queue
        self._late = late
        super().__init__(listener, poller, bounds.SUBSCRIPTION, places)

    def _leaves(self) -> Connection | None:
        idle = (each for each in self._connections.values() if not each.topics)
        return super()._leaves() or next(idle, None)

    def subscribed(self, connection: StreamConnection, before: int) -> None:
        """A subscriber wants other topics now than ``before``, as bits."""
        self._update_wanted()
        late = self._late(connection.topics & ~before)
        if late:
            connection.publish(b"".join(self._on_wire(topic, message) for topic, message in late))

    def _update_wanted(self) -> None:
        self.wanted = 0
        for connection in self._connections.values():
            self.wanted |= connection.topics

    @property
    def backlog(self) -> int:
        return sum(connection.waiting for connection in self._connections.values())

    def publish(self, topic: int, message: bytes) -> None:
        bit = 1 << topic
        wire = self._on_wire(topic, message)
        backlog = 0
        for connection in list(self._connections.values()):
            if connection.topics & bit:
                connection.publish(wire)
            backlog += connection.waiting
        while backlog > bounds.BACKLOG:
            slowest = max(self._connections.values(), key=lambda each: each.waiting)
            backlog -= slowest.waiting
            self.disconnect(slowest)

    def _on_wire(self, topic: int, message: bytes) -> bytes:
        return frame(self._names[topic], more=True) + frame(message)

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        if connection.topics:
            self._update_wanted()
