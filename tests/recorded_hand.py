"""Recordings of the simulated hand at work, made on the virtual clock in a second or two."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack

from daemon import messages
from daemon.assembly import Daemon, facts
from daemon.commands import Handler, Refused
from daemon.profiles import load
from tools.recordings.writer import RecordingWriter


class Script:
    """Commands at their ticks, in the place of the command server."""

    refused_by_pace = 0

    def __init__(self, due: dict[int, dict[str, Any]]) -> None:
        self._due = due
        self._tick = 0

    def serve(self, handler: Handler) -> bool:
        self._tick += 1
        request = self._due.get(self._tick)
        if request is not None:
            try:
                handler(request)
            except Refused:
                pass
        return request is not None

    def drain(self, handler: Handler) -> None:
        pass


def record_hand(
    path: Path,
    due: dict[int, dict[str, Any]],
    seconds: float,
    changes: tuple[str, ...] = (),
    without: tuple[bytes, ...] = (),
) -> None:
    """The commands in ``due`` at their ticks (500 a second); topics ``without`` are left out."""
    settings = load(
        changes=[
            "loop.clock=virtual",
            "stream.state_rate=100",
            f"stream.address=ipc://{path}.stream",
            f"commands.address=ipc://{path}.commands",
            *changes,
        ]
    )
    writer = RecordingWriter(path)

    def take(topic: bytes, message: dict[str, Any]) -> None:
        if topic not in without:
            writer.add(topic, msgpack.unpackb(messages.pack(message)))

    with Daemon(settings) as daemon:
        publisher = daemon.publisher
        assert publisher is not None
        publisher._send = take  # type: ignore[method-assign]
        publisher._subscriptions.add(b"hand/")
        publisher.refresh()
        publisher.settings(daemon.clock.wall(), daemon.clock.now(), facts(settings, daemon.models))
        daemon.loop._server = Script(due)
        daemon.loop.advance(seconds)
    writer.close()
