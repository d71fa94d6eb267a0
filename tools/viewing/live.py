"""The viewer's sockets.

While a picture is drawn nothing is read, on a busy machine for seconds. Messages wait meanwhile in
libzmq's queues: a long one for small messages, of which every one counts, a shorter one for frames,
of which the newest is drawn. Only what these don't hold is lost.
"""

from __future__ import annotations

import time
from typing import Any

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.daemon.wire.schema import TACTILE
from softfinger.tools.viewing.bridge import TOPICS, Bridge
from softfinger.tools.viewing.page import ViewError

_QUEUE = 40_000  # messages: 40 MB, 20 s of state and truth at 1 kHz
_FRAMES = 1_000  # frames: 4 MB, 5 s of two sensors at 100 Hz; 131 MB of the largest grid
_AT_ONCE = 4_000  # messages read before the other socket has its turn


class LiveStream:
    """A context that reads ``address``, with the client's keys if any. Raises ViewError."""

    def __init__(self, address: str, keys: ClientKeys | None = None) -> None:
        self.address = address
        self._context: zmq.Context[Any] = zmq.Context()
        small = [topic for topic in TOPICS if topic != TACTILE]
        try:
            if keys is not None:
                keys.guard(self._context)
            self._sockets = (
                subscribe(self._context, address, *small, queue=_QUEUE),
                subscribe(self._context, address, TACTILE, queue=_FRAMES),
            )
        except zmq.ZMQError as error:
            self.close()
            raise ViewError(f"{address}: {error}") from None
        self._poller = zmq.Poller()
        for socket in self._sockets:
            self._poller.register(socket, zmq.POLLIN)

    def drain(self, bridge: Bridge, until: float) -> int:
        """Give ``bridge`` the messages until the monotonic time ``until`` [s]; their number."""
        count = 0
        while True:
            left = until - time.monotonic()
            if not self._poller.poll(max(0, int(1e3 * left))):
                if left <= 1e-3:
                    return count
                continue
            for socket in self._sockets:
                for message in drain(socket, _AT_ONCE):
                    count += 1
                    try:
                        bridge.take(*unpack(message))
                    except ValueError:
                        bridge.unreadable += 1
            if left <= 0.0:
                return count

    def close(self) -> None:
        """Close the sockets."""
        self._context.destroy(linger=0)

    def __enter__(self) -> LiveStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
