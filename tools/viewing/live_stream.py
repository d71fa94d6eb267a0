"""The stream as page and Foxglove server read it: drained in time, drawn so many times a second."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, Protocol

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.daemon.wire.schema import TACTILE
from softfinger.tools.arguments import PATIENCE, no_stream, waiting
from softfinger.tools.ending import Ending

LOOPBACK = "127.0.0.1"
TOPICS = (
    schema.SETTINGS,
    schema.EVENT,
    schema.STATE,
    schema.TRUTH,
    schema.TACTILE,
    schema.STATS,
    schema.COMMAND,
)
NICE = 5  # everything real-time goes first
_SILENCE = 2.0  # s without a message after which a line says so
_REST = 1.0  # s between two pictures at most, where drawing is slow
_QUEUE = 40_000  # messages: 40 MB, 20 s of state and truth at 1 kHz
_FRAMES = 1_000  # frames: 4 MB, 5 s of two sensors at 100 Hz; 131 MB of the largest grid
_AT_ONCE = 4_000  # messages read before the other socket has its turn


class ViewError(SoftfingerError):
    """Nothing can be shown. The message says why, and what to do."""


class Taker(Protocol):
    """What messages are given to. ``time``: Unix time of the newest state [s], NaN before it."""

    time: float
    unreadable: int

    def take(self, topic: bytes, message: Any) -> None:
        """One message, whatever it holds."""

    def draw(self) -> None:
        """Show what came since the last drawing."""


def follow(
    arguments: argparse.Namespace,
    keys: ClientKeys | None,
    bridge: Taker,
    ending: Ending,
    say: Callable[[str], None],
) -> None:
    """Show the stream that ``arguments`` name until the end. Raises ViewError."""
    period = 1.0 / arguments.rate
    silent = False
    with LiveStream(arguments.address, keys) as stream:
        due = last = time.monotonic()
        while not ending.over:
            count = stream.drain(bridge, due)
            now = time.monotonic()
            if count:
                last = now
                if silent:
                    say("the stream has begun")
                silent = False
            elif arguments.no_wait and now - last > PATIENCE:
                raise ViewError(no_stream(arguments.address, arguments.keys))
            elif not silent and now - last > _SILENCE:
                never = math.isnan(bridge.time)
                say(
                    waiting(arguments.address, arguments.keys)
                    if never
                    else f"silent: {arguments.address}"
                )
                silent = True
            bridge.draw()
            after = time.monotonic()
            # Never busy for more than half of its time, however slow the machine is.
            due = after + max(period - (after - now), min(after - now, _REST))
        stream.drain(bridge, 0.0)
        bridge.draw()


class LiveStream:
    """A context that reads ``address``, with the client's keys if any. Raises ViewError.

    While a picture is drawn nothing is read, on a busy machine for seconds. Messages wait meanwhile
    in libzmq's queues: a long one for small messages, of which every one counts, a shorter one for
    frames, of which the newest is drawn. Only what these don't hold is lost.
    """

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

    def drain(self, bridge: Taker, until: float) -> int:
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
        self._context.destroy(linger=0)

    def __enter__(self) -> LiveStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
