"""The stream's socket as the viewer reads it: all that waits at once, and never the loop's time."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

import msgpack
import zmq

from daemon.keys import ClientKeys
from tools.viewing.bridge import TOPICS, Bridge
from tools.viewing.errors import ViewError

_QUEUE = 4000  # messages that wait in the socket; what comes when it is full is lost
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB


class LiveStream:
    """A context that reads ``address``, with the client's keys if any. Raises ViewError."""

    def __init__(self, address: str, keys: ClientKeys | None = None) -> None:
        self.address = address
        self._context: zmq.Context[Any] = zmq.Context()
        try:
            if keys is not None:
                keys.guard(self._context)
            self._socket = self._context.socket(zmq.SUB)
            self._socket.setsockopt(zmq.LINGER, 0)
            self._socket.setsockopt(zmq.RCVHWM, _QUEUE)
            self._socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
            self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
            for topic in TOPICS:
                self._socket.setsockopt(zmq.SUBSCRIBE, topic)
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            raise ViewError(f"{address}: {error}") from None

    def drain(self, bridge: Bridge, until: float) -> int:
        """Hand on what comes until the monotonic time ``until`` [s]; how many messages it was."""
        count = 0
        while True:
            left = until - time.monotonic()
            if not self._socket.poll(max(0, int(1e3 * left))):
                if left <= 1e-3:
                    return count
                continue
            for _ in range(_QUEUE):
                try:
                    frames = self._socket.recv_multipart(zmq.NOBLOCK)
                except zmq.Again:
                    break
                count += 1
                bridge.take(*_read(frames))
            if left <= 0.0:
                return count

    def close(self) -> None:
        """Close the socket."""
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


def _read(frames: list[bytes]) -> tuple[bytes, Any]:
    """Topic and map; None for a map that is none."""
    if len(frames) != 2:
        return TOPICS[0], None
    try:
        return frames[0], msgpack.unpackb(frames[1])
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        return frames[0], None
