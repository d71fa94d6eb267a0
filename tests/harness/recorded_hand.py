"""Run the simulated hand on the virtual clock, and return or record its published messages."""

from collections import deque
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgpack

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon, hand_info
from softfinger.daemon.profile.load import load
from softfinger.daemon.wire.command_server import Handler
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS
from softfinger.tools.recordings.record import RecordingWriter

Messages = list[tuple[bytes, dict[str, Any]]]


class Script:
    """Replacement for the command server that issues commands on their ticks."""

    refused_by_pace = 0

    def __init__(self, due: dict[int, dict[str, Any]]) -> None:
        self._due = due
        self._tick = 0
        self.refused = 0
        self.notices: deque[str] = deque()

    def serve(self, handler: Handler) -> None:
        self._tick += 1
        request = self._due.get(self._tick)
        if request is not None:
            try:
                handler(request)
            except Refused:
                self.refused += 1

    def raise_fence(self) -> None:
        pass


class Keeping(Link):
    """Replacement for the gateway link that stores published messages."""

    def __init__(self, taken: Messages) -> None:
        super().__init__()
        self._taken = taken
        self.wanted = -1

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        self._taken.append((GATEWAY_TOPICS[topic].encode(), msgpack.unpackb(message)))


def published(
    folder: Path,
    script: Script,
    seconds: float,
    changes: tuple[str, ...] = (),
    profile: str | None = None,
    hand: tuple[str, ...] = (),
) -> Messages:
    """Return all messages that the hand publishes under ``script``; ``folder`` is for its sockets.

    ``hand`` contains settings that apply only to the simulated hand, not to the daemon.
    """
    common = (
        "loop.clock=virtual",
        "stream.state_rate=100",
        f"stream.address=ipc://{folder}/stream",
        f"commands.address=ipc://{folder}/commands",
        *changes,
    )
    path = None if profile is None else Path(profile)
    settings = load(path, changes=common)
    taken: Messages = []
    with Daemon(settings, hand=load(path, changes=(*common, *hand))) as daemon:
        publisher = daemon.publisher
        publisher._link = Keeping(taken)
        publisher.settings(
            daemon.clock.wall(), daemon.clock.now(), hand_info(settings, daemon.models)
        )
        daemon.loop._server = script
        daemon.loop.advance(seconds)
    return taken


def record_hand(
    path: Path,
    due: dict[int, dict[str, Any]],
    seconds: float,
    changes: tuple[str, ...] = (),
    without: tuple[bytes, ...] = (),
    profile: str | None = None,
    hand: tuple[str, ...] = (),
) -> None:
    """Record a run in which the commands in ``due`` are issued on their ticks (500 per second).

    Topics in ``without`` are omitted.
    """
    writer = RecordingWriter(path)
    with TemporaryDirectory() as folder:
        for topic, message in published(Path(folder), Script(due), seconds, changes, profile, hand):
            if topic not in without:
                writer.add(topic, message)
    writer.close()
