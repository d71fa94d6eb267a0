"""The stream as page and Foxglove server read it: drained in time, drawn at a rate."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import zmq

from softfinger.daemon.client.connection import drain, subscribe, unpack
from softfinger.daemon.client.stream import Gaps
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.daemon.wire.schema import TACTILE
from softfinger.tools.arguments import PATIENCE, no_stream, waiting
from softfinger.tools.ending import Ending
from softfinger.tools.terminal.feed import number, printable, text
from softfinger.tools.viewing.known import ShownHand, read_settings

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


class Viewer:
    """Takes messages of any content: the newest of each topic, and the hand by its settings.

    ``time`` is that of the newest state [Unix s], NaN before it. ``say`` is told what is unknown.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._same_schema = True
        self._settings = ""  # as they came
        self.states = self.unreadable = 0
        self.hand = ShownHand()
        self.clear()
        self.know(self.hand)

    def clear(self) -> None:
        """Forget all but the hand: what comes next is of another time."""
        self.time = math.nan
        self.newest: dict[bytes, dict[str, Any]] = {}
        self.gaps = {topic: Gaps() for topic in TOPICS}

    def know(self, hand: ShownHand) -> None:
        """Show this hand from now on."""
        self.hand = hand

    def take(self, topic: bytes, message: Any) -> bool:
        """Keep one message; False where it can't be read, or came before."""
        if topic not in self.gaps:
            return False
        stamp = number(message, "timestamp")
        if not 0.0 <= stamp < 2.0**32:
            self.unreadable += 1
            return False
        if not self.gaps[topic].take(message):
            return False
        if message.get("schema") != schema.SCHEMA and self._same_schema:
            self._same_schema = False
            self._say(
                f"the stream is of schema {message.get('schema')!r:.20}, this viewer knows "
                f"{schema.SCHEMA}; it keeps to the fields it knows"
            )
        self.newest[topic] = message
        if topic == schema.STATE:
            self.time = stamp
            self.states += 1
        elif topic == schema.SETTINGS and text(message, "settings") != self._settings:
            self._settings = text(message, "settings")
            settings, unknown = read_settings(message)
            if unknown:
                version = text(message, "version") or "another version"
                keys = printable(", ".join(unknown))
                self._say(f"settings of {version} that are not known here: {keys}")
            self.know(ShownHand(settings))
        return True

    def draw(self) -> None:
        """Show what came since the last drawing."""


def follow(
    arguments: argparse.Namespace,
    keys: ClientKeys | None,
    viewer: Viewer,
    ending: Ending,
    say: Callable[[str], None],
) -> None:
    """Show the stream that ``arguments`` name until the end. Raises ViewError."""
    period = 1.0 / arguments.rate
    silent = False
    with live_stream(arguments.address, keys) as drain_to:
        due = last = time.monotonic()
        while not ending.over:
            count = drain_to(viewer, due)
            now = time.monotonic()
            if count:
                last = now
                if silent:
                    say("the stream has begun")
                silent = False
            elif arguments.no_wait and now - last > PATIENCE:
                raise ViewError(no_stream(arguments.address, arguments.keys))
            elif not silent and now - last > _SILENCE:
                never = math.isnan(viewer.time)
                say(
                    waiting(arguments.address, arguments.keys)
                    if never
                    else f"silent: {arguments.address}"
                )
                silent = True
            viewer.draw()
            after = time.monotonic()
            # Never busy for more than half of its time, however slow the machine is.
            due = after + max(period - (after - now), min(after - now, _REST))
        drain_to(viewer, 0.0)
        viewer.draw()


Drain = Callable[[Viewer, float], int]


@contextmanager
def live_stream(address: str, keys: ClientKeys | None = None) -> Iterator[Drain]:
    """Subscribe to ``address``, with the client's keys if any; yields `_drain` of it.

    While a picture is drawn nothing is read, on a busy machine for seconds. Messages wait meanwhile
    in libzmq's queues: a long one for small messages, of which every one counts, a shorter one for
    frames, of which the newest is drawn. Only what these don't hold is lost. Raises ViewError.
    """
    small = [topic for topic in TOPICS if topic != TACTILE]
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        try:
            if keys is not None:
                keys.guard(context)
            sockets = [
                stack.enter_context(subscribe(context, address, *small, queue=_QUEUE)),
                stack.enter_context(subscribe(context, address, TACTILE, queue=_FRAMES)),
            ]
        except zmq.ZMQError as error:
            raise ViewError(f"{address}: {error}") from None
        poller = zmq.Poller()
        for socket in sockets:
            poller.register(socket, zmq.POLLIN)
        yield partial(_drain, sockets, poller)


def _drain(sockets: list[zmq.Socket[Any]], poller: zmq.Poller, viewer: Viewer, until: float) -> int:
    """Give ``viewer`` the messages until the monotonic time ``until`` [s]; their number."""
    count = 0
    while True:
        left = until - time.monotonic()
        if not poller.poll(max(0, int(1e3 * left))):
            if left <= 1e-3:
                return count
            continue
        for socket in sockets:
            for message in drain(socket, _AT_ONCE):
                count += 1
                try:
                    viewer.take(*unpack(message))
                except ValueError:
                    viewer.unreadable += 1
        if left <= 0.0:
            return count
