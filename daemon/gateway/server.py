"""The gateway's process: one thread that waits for the loop and for clients, and serves both.

``python -m softfinger.daemon.gateway.server FD CONFIG``: the link's descriptor, and a `Config` as
JSON. Its sockets are bound first; it ends when the loop hangs up.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import zmq

from softfinger.daemon.errors import AddressError, KeyFileError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import (
    Admission,
    CommandEndpoint,
    StartAnew,
    StreamEndpoint,
)
from softfinger.daemon.gateway.request_queue import RequestQueue, Route
from softfinger.daemon.wire import loop_link
from softfinger.daemon.wire.loop_link import Topics

_STEPS = 0.5  # s between two words that it lives
_TURN = 5e-4  # s that the authenticator waits for the interpreter while requests flood


class Repeated:
    """Keep settings and last events for late subscribers, marked as sent again."""

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
        """Yield each message with its topic for a subscriber to ``wanted``, topics as bits."""
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
        self,
        end: socket.socket,
        config: Config,
        clock: Callable[[], float] = loop_link.machine_time,
    ) -> None:
        """Bind what ``config`` names; ``end`` is this end of the link.

        Raises AddressError, and KeyFileError where there are keys.
        """
        self._clock = clock
        self._end = end
        self.requests = RequestQueue(
            config.max_bytes, config.per_second, self._forward, self._answer
        )
        self._repeated = Repeated(config.topics)
        self._reported = b""  # wanted topics and refused requests, as the loop knows them
        self._fence = 0
        self._told_past = -math.inf  # as the loop knows it
        self._unsent: deque[bytes] = deque(maxlen=bounds.UNSENT)
        self._pieces = bytearray()
        self.over = False
        folder = Path(config.keys) if config.keys else None
        self._context: zmq.Context[Any] = zmq.Context()
        self._admission = Admission(self._context, folder)
        self._stream: StreamEndpoint | None = None
        self._commands: CommandEndpoint | None = None
        self._poller = zmq.Poller()
        self._poller.register(end, zmq.POLLIN)
        try:
            if config.stream:
                self._stream = StreamEndpoint(self._admission, config, self._repeated.late)
                self._poller.register(self._stream.socket, zmq.POLLIN)
            if config.commands:
                self._commands = CommandEndpoint(self._admission, config, self.requests, clock)
                self._poller.register(self._commands.socket, zmq.POLLIN)
        except BaseException:
            self._close_sockets()
            raise

    def step(self, seconds: float = bounds.TEND) -> None:
        """Wait for the loop or a client for so long at most, and serve them."""
        self._poller.poll(0 if self._unsent else int(1e3 * seconds))
        now = self._clock()
        self._admission.look(now)
        self._take_packets()
        self._publish_some()
        wanted = 0
        if self._stream is not None:
            self._stream.read(now)
            wanted = self._stream.wanted
        if self._commands is not None:
            self._commands.read()
            self.requests.pump(self._clock())
            self._tell_past(self._commands.past)
        report = loop_link.WANTED + loop_link.WANTS.pack(wanted, self.requests.refused)
        if report != self._reported and self._send(report):
            self._reported = report

    def _tell_past(self, past: float) -> None:
        if past < math.inf and past != self._told_past:
            packet = loop_link.PAST + loop_link.FENCE_PAST.pack(self._fence, past)
            if self._send(packet):
                self._told_past = past

    def _answer(self, route: Route, reply: bytes) -> None:
        if self._commands is not None:
            self._commands.answer(route, reply)

    def _send(self, packet: bytes) -> bool:
        try:
            self._end.send(packet)
        except BlockingIOError:
            return False
        except OSError:
            self.over = True
            return False
        return True

    def _forward(self, stop: bool, came: float, number: int, packed: bytes) -> bool:
        kind = loop_link.STOP if stop else loop_link.ASK
        return self._send(kind + loop_link.ASKED.pack(came, number) + packed)

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
            elif kind == loop_link.FENCE:
                (self._fence,) = loop_link.NUMBER.unpack_from(packet, 1)
                if self._commands is not None:
                    self._commands.raise_fence()

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
        again = self._repeated.add(topic, message)
        if self._stream is not None:
            # Subscribers may have come back before the loop has: they get its last events, too.
            self._stream.publish(topic, again if flags & loop_link.KEEP else message)

    def close(self) -> None:
        """Let subscribers take what waits, for a moment, and disconnect all."""
        deadline = time.monotonic() + bounds.LAST_WORDS
        self._end.close()
        while self._unsent and time.monotonic() < deadline:
            self._publish_some()
        self._close_sockets()

    def _close_sockets(self) -> None:
        for endpoint in (self._stream, self._commands):
            if endpoint is not None:
                endpoint.close()
        self._admission.stop()
        self._context.term()


def main(words: list[str]) -> int:
    """Serve; 0 when the loop has ended, 1 when the sockets could not be bound.

    `loop_link.ANEW` when all clients are to come in again.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the loop, whose last words it sends
    try:
        return _serve(socket.socket(fileno=int(words[0])), Config.from_json(words[1]))
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the loop ended before all was sent


def _serve(end: socket.socket, config: Config) -> int:
    try:
        _be_bounded()
        server = Server(end, config)
    except (AddressError, KeyFileError) as error:
        end.send(loop_link.FAILED + str(error).encode()[: loop_link.LARGEST // 2])
        return 1
    sys.setswitchinterval(_TURN)
    end.send(loop_link.READY)
    lived = 0.0
    try:
        while not server.over:
            server.step()
            now = time.monotonic()
            if now - lived > _STEPS:
                lived = now
                # Neither SIGPROF nor SIGALRM is handled: each ends it.
                signal.setitimer(signal.ITIMER_PROF, bounds.STALLED)
                signal.setitimer(signal.ITIMER_REAL, bounds.BLOCKED)
    except StartAnew as reason:
        end.send(loop_link.NOTICE + str(reason).encode())
        return loop_link.ANEW
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    server.close()
    return 0


def _be_bounded() -> None:
    """Bound memory, be the first to go when the system has none, and be no real-time process."""
    resource.setrlimit(resource.RLIMIT_DATA, (bounds.MEMORY, bounds.MEMORY))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = bounds.CLIENTS + bounds.DESCRIPTORS
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    try:
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        pass  # not worth doing without the hand


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
