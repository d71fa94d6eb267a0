"""The sockets of one who looks at the hand and commands it, without waiting.

`FeedSubscriber` takes the stream into a feed, `Commander` sends what a person asks for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgpack
import zmq

from softfinger.daemon.client.command_client import LOCALLY, UNCONFIRMED
from softfinger.daemon.client.connection import PATIENCE, SILENCE, drain, subscribe
from softfinger.daemon.wire.local_stop import stop_locally
from softfinger.tools.terminal.feed import Feed, field, text

_DRAIN_LIMIT = 4000  # messages taken at once, so that a flood can't keep the page from drawing
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB


class FeedSubscriber:
    """The stream's socket: everything that waits is taken into a feed."""

    def __init__(self, context: zmq.Context[Any], address: str, feed: Feed) -> None:
        self.feed = feed
        self._socket = subscribe(context, address, *feed.topics, queue=_DRAIN_LIMIT)

    def drain(self, now: float) -> None:
        for message in drain(self._socket, _DRAIN_LIMIT):
            self.feed.take(message, now)

    def close(self) -> None:
        self._socket.close()


@dataclass(frozen=True, slots=True)
class ShownReply:
    """What came of a command, for the page."""

    at: float
    ok: bool
    text: str


@dataclass(slots=True)
class _Pending:
    """A command that is not answered yet."""

    label: str
    socket: zmq.Socket[bytes]
    sent: float
    warned: bool = False  # that it takes long


class Commander:
    """Sends commands without waiting for their replies. The newest one is kept in ``reply``.

    Each command has a request socket of its own: an answer that never comes holds nothing up,
    a stop least of all. To a daemon of this user on this machine, a stop goes past all clients; its
    answer comes at the next tick, and a daemon that stands still is given a moment for it.
    """

    OPEN_LIMIT = 8  # commands under way; further ones are dropped, except stop

    def __init__(self, context: zmq.Context[Any], address: str, client: str = "") -> None:
        self._context = context
        self._address = address
        self._envelope = {"client": client} if client else {}
        self._pending: list[_Pending] = []
        self.reply: ShownReply | None = None

    def send(self, now: float, label: str, command: str, **fields: float) -> None:
        """Send ``command`` with ``fields``; the reply is shown under ``label``."""
        if len(self._pending) >= self.OPEN_LIMIT and command != "stop":
            self.reply = ShownReply(now, False, f"{label}: dropped, the daemon doesn't answer")
            return
        if command == "stop":
            stopped = stop_locally(self._address, LOCALLY)
            if stopped is not None:
                self.reply = self._judge(now, label, stopped)
                return
        request = self._context.socket(zmq.REQ)
        request.setsockopt(zmq.LINGER, 0)
        request.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
        request.connect(self._address)
        request.send(msgpack.packb({"command": command, **self._envelope, **fields}), zmq.NOBLOCK)
        self._pending.append(_Pending(label, request, now))

    def refuse(self, now: float, why: str) -> None:
        """Say that a key was not turned into a command."""
        self.reply = ShownReply(now, False, why)

    def collect(self, now: float) -> None:
        """Take the replies that came, give up on those that are overdue."""
        waiting = []
        for each in self._pending:
            try:
                payload = each.socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                overdue = now - each.sent >= PATIENCE
                if overdue or (not each.warned and now - each.sent >= SILENCE):
                    each.warned = True
                    so_far = f"within {PATIENCE:g} s" if overdue else f"yet, {PATIENCE:g} s at most"
                    late = f"{each.label}: no answer from {self._address} {so_far}"
                    self.reply = ShownReply(now, False, late)
                if not overdue:
                    waiting.append(each)
                    continue
            else:
                self.reply = self._read(now, each.label, payload)
            each.socket.close()
        self._pending = waiting

    def _read(self, now: float, label: str, payload: bytes) -> ShownReply:
        try:
            record = msgpack.unpackb(payload)
        except (ValueError, RecursionError, msgpack.UnpackException):
            record = None
        return self._judge(now, label, record)

    @staticmethod
    def _judge(now: float, label: str, record: Any) -> ShownReply:
        if field(record, "ok") is True:
            if text(record, "torque_off") == "unconfirmed":
                return ShownReply(now, False, f"{label}: {UNCONFIRMED}")
            return ShownReply(now, True, f"{label}: ok")
        why = text(record, "error") or "an answer that can't be read"
        named = why.split(":")[0] == label.split()[0]  # the daemon names the command itself
        return ShownReply(now, False, why if named else f"{label}: {why}")

    def close(self) -> None:
        """Close what is open; commands that were not taken yet are dropped."""
        for each in self._pending:
            each.socket.close()
        self._pending = []
