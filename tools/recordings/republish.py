"""A recording's messages on the daemon's wire again: the socket, and what late subscribers miss."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any

import zmq

from daemon import messages
from daemon.contradictions import address_fault
from daemon.doorkeeper import Doorkeeper
from daemon.keys import KeyFileError, load_server
from daemon.sockets import AddressError, Bound, Guard
from tools.recordings.errors import RecordingError

_QUEUE = 10_000  # messages that wait for a subscriber; what it does not take by then it misses
_SUBSCRIPTION = 1024  # bytes
_EVENTS = 50  # told again to whoever comes later


class Wire:
    """Publishes on ``address``, with keys to their holders alone. A context.

    Raises RecordingError when the address can't be had, or would reach other machines without keys.
    """

    def __init__(self, address: str, keys: Path | None = None) -> None:
        fault = address_fault(address, "" if keys is not None else "--keys")
        if fault:
            raise RecordingError(f"--address: {fault}")
        self._context: zmq.Context[Any] = zmq.Context()
        self._doorkeeper: Doorkeeper | None = None
        self._settings: dict[str, Any] | None = None
        self._events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        try:
            server = None if keys is None else load_server(keys)
            guard = Guard(keys=server, asks=True)
            self._doorkeeper = Doorkeeper(self._context, None if server is None else server.clients)
            self._bound = Bound(
                self._context, zmq.XPUB, address, "--address", _QUEUE, _SUBSCRIPTION, guard
            )
        except (AddressError, KeyFileError) as error:
            self._end()
            raise RecordingError(str(error)) from None
        self._bound.socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # tells every subscriber, not the first

    def subscribed(self, seconds: float) -> bool:
        """Wait that long and see to those who subscribe meanwhile; whether somebody did."""
        deadline = time.monotonic() + seconds
        came = False
        while self._bound.socket.poll(max(0, round(1e3 * (deadline - time.monotonic())))):
            change = self._bound.socket.recv()
            if change[:1] == b"\x01":
                came = True
                self._tell_again(change[1:])
        return came

    def send(self, topic: bytes, message: dict[str, Any]) -> None:
        """Publish one message."""
        if topic == messages.SETTINGS:
            self._settings = message
        elif topic == messages.EVENT:
            self._events.append(message)
        self._bound.socket.send_multipart([topic, messages.pack(message)])
        if self._bound.readable():
            self.subscribed(0.0)

    def _tell_again(self, prefix: bytes) -> None:
        """What a daemon tells again, too: settings and the last events."""
        kept = [] if self._settings is None else [(messages.SETTINGS, self._settings)]
        kept += [(messages.EVENT, event) for event in self._events]
        for topic, message in kept:
            if topic.startswith(prefix):
                again = messages.pack({**message, "again": True})
                self._bound.socket.send_multipart([topic, again])

    def _end(self) -> None:
        if self._doorkeeper is not None:
            self._doorkeeper.close()
        self._context.term()

    def __enter__(self) -> Wire:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bound.close()
        self._end()
