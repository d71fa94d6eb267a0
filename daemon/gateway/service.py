"""What the gateway does: one thread that waits for the loop and for clients, and serves both."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import msgpack

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.gateway import link
from softfinger.daemon.gateway.admission import Requests
from softfinger.daemon.gateway.config import Config, Topics
from softfinger.daemon.gateway.peers import Commands, Stream
from softfinger.daemon.gateway.poll import Poll
from softfinger.daemon.wire.sockets import Listener

_TEND = 0.01  # s between looks at what is due by the time
_PACKETS = 64  # packets of the loop taken in at a look
_STACK = 1000  # of them that wait to be sent; the oldest are dropped
_PUBLISHING = 0.004  # s of sending before clients are looked at again, …
_SERVING = 0.004  # … and of looking at clients before the loop is heard again
_LATEST = 50  # events that a late subscriber is told
_LARGEST = 64 << 20  # bytes of a message that comes in pieces
_LAST_WORDS = 0.2  # s for subscribers to take what waits when the loop has ended


class AnyDoor(Protocol):
    """Where clients come in."""

    now: float

    @property
    def begun(self) -> int:
        """The epoch of who comes in from now on."""

    def tend(self) -> None:
        """See to what is due by the time."""

    def begin_epoch(self, epoch: int) -> None:
        """Requests that arrived before are not to be given this epoch."""

    def close(self) -> None:
        """Hang up on all."""


class StreamDoor(AnyDoor, Protocol):
    """Where subscribers come in."""

    wanted: int  # topics as bits
    backlog: int  # bytes that wait for them

    def publish(self, topic: int, message: bytes) -> None:
        """One message to all who want its topic."""


class StartAnew(SoftfingerError):
    """All connections are to end, and clients to come in again. The message says why."""


class Kept:
    """What late subscribers are told: the settings and the latest events, marked as told again."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._settings: bytes | None = None
        self._events: deque[bytes] = deque(maxlen=_LATEST)  # packed, as the settings

    def add(self, topic: int, message: bytes) -> None:
        """Remember a message of the stream, if it is one of these."""
        if topic == self._topics.settings:
            self._settings = _again(message)
        elif topic == self._topics.events:
            self._events.append(_again(message))

    def late(self, wanted: int) -> list[tuple[int, bytes]]:
        """For a subscriber to the topics ``wanted``, as bits: each message with its topic."""
        settings, events = self._topics.settings, self._topics.events
        told = []
        if self._settings is not None and wanted >> settings & 1:
            told.append((settings, self._settings))
        if wanted >> events & 1:
            told += [(events, event) for event in self._events]
        return told


def _again(message: bytes) -> bytes:
    packed: bytes = msgpack.packb({**msgpack.unpackb(message), "again": True})
    return packed


class Service:
    """Serves clients until the loop hangs up: call `step` again and again."""

    def __init__(
        self,
        end: socket.socket,
        topics: Topics,
        max_bytes: int,
        per_second: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``end`` is this end of the link. Doors are added by `add`."""
        self._clock = clock
        self.poll = Poll()
        self.requests = Requests(max_bytes, per_second, self._forward)
        self.kept = Kept(topics)
        self._end = end
        self._doors: list[AnyDoor] = []
        self._stream: StreamDoor | None = None
        self._told = (0, 0)  # wanted topics and refused requests, as the loop knows them
        self._begun = 0  # the epoch, as the loop knows it
        self._stack: deque[bytes] = deque(maxlen=_STACK)  # published, and not yet sent
        self._pieces = bytearray()
        self._tend_at = 0.0
        self.now = 0.0
        self.over = False
        self.poll.watch(end.fileno(), select.EPOLLIN, lambda _: self._hear())

    def add(self, door: AnyDoor, stream: StreamDoor | None = None) -> None:
        """Serve those who come in there; ``stream`` is the door that takes the stream, too."""
        self._doors.append(door)
        self._stream = stream or self._stream

    def step(self, seconds: float = _TEND) -> None:
        """Wait for the loop or a client for so long at most, and serve them."""
        self._set_time()
        self.poll.step(0.0 if self._stack else seconds, _SERVING)
        self._hear()
        self._publish_some()
        now = self._set_time()
        if now >= self._tend_at:
            self._tend_at = now + _TEND
            for door in self._doors:
                door.tend()
        self.requests.pump(now)
        epoch = min((door.begun for door in self._doors), default=0)
        if epoch != self._begun and self._send(link.BEGUN + link.EPOCHS.pack(epoch)):
            self._begun = epoch
        told = (self._stream.wanted if self._stream is not None else 0, self.requests.refused)
        if told != self._told and self._send(link.WANTED + link.WANTS.pack(*told)):
            self._told = told

    def _set_time(self) -> float:
        now = self._clock()
        for door in self._doors:
            door.now = now
        self.now = now
        return now

    def _send(self, packet: bytes) -> bool:
        try:
            self._end.send(packet)
        except BlockingIOError:
            return False
        except OSError:
            self.over = True
            return False
        return True

    def _forward(self, stop: bool, epoch: int, number: int, packed: bytes) -> bool:
        kind = link.STOP if stop else link.ASK
        return self._send(kind + link.ASKED.pack(epoch, number) + packed)

    def _hear(self) -> None:
        """Take in what the loop says."""
        for _ in range(_PACKETS):
            try:
                packet = self._end.recv(link.LARGEST)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self.over = True
                return
            kind = packet[:1]
            if kind == link.PUBLISH:
                self._stack.append(packet)  # replies behind it must not wait for its sending
            elif kind == link.REPLY:
                self.requests.reply(link.NUMBER.unpack_from(packet, 1)[0], packet[5:])
            elif kind == link.EPOCH:
                epoch = link.EPOCHS.unpack_from(packet, 1)[0]
                self.requests.begin_epoch(epoch)
                for door in self._doors:
                    door.begin_epoch(epoch)

    def _publish_some(self) -> None:
        """Send what the loop published, for as long as clients may wait."""
        until = time.monotonic() + _PUBLISHING
        while self._stack:
            packet = self._stack.popleft()
            self._publish(packet[1], packet[2], packet[3:])
            if time.monotonic() > until:
                break

    def _publish(self, topic: int, flags: int, piece: bytes) -> None:
        message = piece
        if flags & (link.FIRST | link.LAST) != link.FIRST | link.LAST:
            if flags & link.FIRST:
                self._pieces.clear()
            elif not self._pieces:
                return  # its beginning was lost
            self._pieces += piece
            if len(self._pieces) > _LARGEST:
                self._pieces.clear()
            if not flags & link.LAST or not self._pieces:
                return
            message = bytes(self._pieces)
            self._pieces.clear()
        self.kept.add(topic, message)
        if self._stream is not None and not flags & link.KEEP:
            self._stream.publish(topic, message)

    def close(self) -> None:
        """Let subscribers take what waits, for a moment, and hang up."""
        deadline = time.monotonic() + _LAST_WORDS
        self.poll.forget(self._end.fileno())
        self._end.close()
        while self._stack and time.monotonic() < deadline:
            self._publish_some()
        while self._stream is not None and self._stream.backlog and time.monotonic() < deadline:
            self.poll.step(0.01, _SERVING)
        for door in self._doors:
            door.close()
        self.poll.close()


def open_service(
    end: socket.socket,
    config: Config,
    places: int,
    clock: Callable[[], float] = time.monotonic,
) -> Service:
    """Bind what ``config`` names, for ``places`` clients.

    Raises AddressError, and KeyFileError where there are keys.
    """
    service = Service(end, config.topics, config.max_bytes, config.per_second, clock)
    if config.keys:
        from softfinger.daemon.gateway.curve import open_doors  # which alone needs libzmq

        open_doors(service, config)
        return service
    if config.stream:
        listener = Listener(config.stream, config.stream_key, config.ipc_mode)
        subscribers = places // 4
        stream = Stream(
            listener, service.poll, subscribers, config.queue, config.topics, service.kept.late
        )
        service.add(stream, stream)
    if config.commands:
        listener = Listener(config.commands, "commands.address", config.ipc_mode)
        limit = 4 * config.max_bytes
        service.add(Commands(listener, service.poll, limit, places, service.requests))
    return service
