"""What the gateway does: one thread that waits for the loop and for clients, and serves both."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable

import msgpack

from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import Endpoint, Poller
from softfinger.daemon.gateway.request_queue import RequestQueue
from softfinger.daemon.wire import loop_link
from softfinger.daemon.wire.loop_link import Topics


class Repeated:
    """What late subscribers get: the settings and the last events, marked as sent again."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._settings: bytes | None = None
        self._events: deque[bytes] = deque(maxlen=bounds.LATE_EVENTS)

    def add(self, topic: int, message: bytes) -> bytes:
        """Remember a message of the stream, if it is one of these: as it is then sent again."""
        if topic not in (self._topics.settings, self._topics.events):
            return message
        again: bytes = msgpack.packb({**msgpack.unpackb(message), "again": True})
        if topic == self._topics.events:
            self._events.append(again)
        else:
            self._settings = again
        return again

    def late(self, wanted: int) -> list[tuple[int, bytes]]:
        """For a subscriber to the topics ``wanted``, as bits: each message with its topic."""
        settings, events = self._topics.settings, self._topics.events
        found = []
        if self._settings is not None and wanted >> settings & 1:
            found.append((settings, self._settings))
        if wanted >> events & 1:
            found += [(events, event) for event in self._events]
        return found


class Server:
    """Serves clients until the loop hangs up: call `step` again and again."""

    def __init__(
        self, end: socket.socket, config: Config, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``end`` is this end of the link. Endpoints are added by `add`."""
        self._clock = clock
        self.poller = Poller()
        self.requests = RequestQueue(config.max_bytes, config.per_second, self._forward)
        self.repeated = Repeated(config.topics)
        self._end = end
        self._endpoints: list[Endpoint] = []
        self._reported = b""  # wanted topics and refused requests, as the loop knows them
        self._begun = 0  # the epoch, as the loop knows it
        self._unsent: deque[bytes] = deque(maxlen=bounds.UNSENT)
        self._pieces = bytearray()
        self._tend_at = 0.0
        self.now = 0.0
        self.over = False
        self.poller.watch(end.fileno(), select.EPOLLIN, lambda _: self._take_packets())

    def add(self, endpoint: Endpoint) -> None:
        """Serve those who come in there."""
        self._endpoints.append(endpoint)

    def step(self, seconds: float = bounds.TEND) -> None:
        """Wait for the loop or a client for so long at most, and serve them."""
        self._set_time()
        self.poller.step(0.0 if self._unsent else seconds, bounds.TURN)
        self._take_packets()
        self._publish_some()
        now = self._set_time()
        if now >= self._tend_at:
            self._tend_at = now + bounds.TEND
            for endpoint in self._endpoints:
                endpoint.tend()
        self.requests.pump(now)
        begun = min((endpoint.begun for endpoint in self._endpoints), default=0)
        if begun != self._begun and self._send(loop_link.BEGUN + loop_link.EPOCHS.pack(begun)):
            self._begun = begun
        wanted = max((endpoint.wanted for endpoint in self._endpoints), default=0)
        report = loop_link.WANTED + loop_link.WANTS.pack(wanted, self.requests.refused)
        if report != self._reported and self._send(report):
            self._reported = report

    def _set_time(self) -> float:
        now = self._clock()
        for endpoint in self._endpoints:
            endpoint.now = now
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
        kind = loop_link.STOP if stop else loop_link.ASK
        return self._send(kind + loop_link.ASKED.pack(epoch, number) + packed)

    def _take_packets(self) -> None:
        for _ in range(bounds.FROM_LOOP):
            try:
                packet = self._end.recv(loop_link.LARGEST)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self.over = True
                return
            kind = packet[:1]
            if kind == loop_link.PUBLISH:
                self._unsent.append(packet)  # replies behind it must not wait for its sending
            elif kind == loop_link.REPLY:
                self.requests.reply(loop_link.NUMBER.unpack_from(packet, 1)[0], packet[5:])
            elif kind == loop_link.EPOCH:
                epoch = loop_link.EPOCHS.unpack_from(packet, 1)[0]
                self.requests.begin_epoch(epoch)
                for endpoint in self._endpoints:
                    endpoint.begin_epoch(epoch)

    def _publish_some(self) -> None:
        """Send what the loop published, for as long as clients may wait."""
        until = time.monotonic() + bounds.TURN
        while self._unsent:
            packet = self._unsent.popleft()
            self._publish(packet[1], packet[2], packet[3:])
            if time.monotonic() > until:
                break

    def _publish(self, topic: int, flags: int, piece: bytes) -> None:
        message = piece
        if flags & (loop_link.FIRST | loop_link.LAST) != loop_link.FIRST | loop_link.LAST:
            if flags & loop_link.FIRST:
                self._pieces.clear()
            elif not self._pieces:
                return  # its beginning was lost
            self._pieces += piece
            if len(self._pieces) > bounds.LARGEST:
                self._pieces.clear()
            if not flags & loop_link.LAST or not self._pieces:
                return
            message = bytes(self._pieces)
            self._pieces.clear()
        again = self.repeated.add(topic, message)
        for endpoint in self._endpoints:
            # Subscribers may have come back before the loop has: they get its last events, too.
            endpoint.publish(topic, again if flags & loop_link.KEEP else message)

    def close(self) -> None:
        """Let subscribers take what waits, for a moment, and disconnect all."""
        deadline = time.monotonic() + bounds.LAST_WORDS
        self.poller.forget(self._end.fileno())
        self._end.close()
        while self._unsent and time.monotonic() < deadline:
            self._publish_some()
        while any(each.backlog for each in self._endpoints) and time.monotonic() < deadline:
            self.poller.step(0.01, bounds.TURN)
        for endpoint in self._endpoints:
            endpoint.close()
        self.poller.close()
