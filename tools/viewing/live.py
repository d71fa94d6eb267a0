"""The stream's sockets as the viewer reads them: all that waits at once, and never the loop's time.

While a picture is drawn nothing is read, on a busy machine for seconds. What comes meanwhile waits
in libzmq's own queues, which its own thread fills: long ones for small messages, of which every one
counts, a shorter one for frames, of which the newest is drawn. Only what these don't hold is lost.
"""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

import msgpack
import zmq

from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.tools.viewing.bridge import TOPICS, Bridge
from softfinger.tools.viewing.errors import ViewError

_QUEUE = 40_000  # messages: 40 MB, 20 s of state and truth at 1 kHz
_FRAMES = 1_000  # frames: 4 MB, 5 s of two sensors at 100 Hz; 131 MB of the largest grid
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB
_AT_ONCE = 4_000  # messages read before the other socket has its turn


class LiveStream:
    """A context that reads ``address``, with the client's keys if any. Raises ViewError."""

    def __init__(self, address: str, keys: ClientKeys | None = None) -> None:
        self.address = address
        self._context: zmq.Context[Any] = zmq.Context()
        self._sockets: list[zmq.Socket[Any]] = []
        self._poller = zmq.Poller()
        small = [topic for topic in TOPICS if topic != schema.TACTILE]
        try:
            if keys is not None:
                keys.guard(self._context)
            for topics, queue in ((small, _QUEUE), ([schema.TACTILE], _FRAMES)):
                socket = self._context.socket(zmq.SUB)
                self._sockets.append(socket)
                self._poller.register(socket, zmq.POLLIN)
                socket.setsockopt(zmq.LINGER, 0)
                socket.setsockopt(zmq.RCVHWM, queue)
                socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
                socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
                for topic in topics:
                    socket.setsockopt(zmq.SUBSCRIBE, topic)
                socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            raise ViewError(f"{address}: {error}") from None

    def drain(self, bridge: Bridge, until: float) -> int:
        """Hand on what comes until the monotonic time ``until`` [s]; how many messages it was."""
        count = 0
        while True:
            left = until - time.monotonic()
            if not self._poller.poll(max(0, int(1e3 * left))):
                if left <= 1e-3:
                    return count
                continue
            for socket in self._sockets:
                count += _hand_on(socket, bridge)
            if left <= 0.0:
                return count

    def close(self) -> None:
        """Close the sockets."""
        self._context.destroy(linger=0)

    def __enter__(self) -> LiveStream:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _hand_on(socket: zmq.Socket[Any], bridge: Bridge) -> int:
    """What waits in one socket; how many messages it was."""
    for count in range(_AT_ONCE):
        try:
            frames = socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return count
        bridge.take(*_read(frames))
    return _AT_ONCE


def _read(frames: list[bytes]) -> tuple[bytes, Any]:
    """Topic and map; None for a map that is none."""
    if len(frames) != 2:
        return TOPICS[0], None
    try:
        return frames[0], msgpack.unpackb(frames[1])
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        return frames[0], None
