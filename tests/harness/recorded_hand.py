"""Record given messages, or the simulated hand while it executes commands at given ticks."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from softfinger import Refused
from softfinger.testing import VirtualHand
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import RecordingWriter

TICK = 0.002  # s


def write_recording(path: Path, messages: Iterable[tuple[bytes, dict[str, Any]]] = ()) -> Recording:
    """Write ``messages`` to a new recording and open it."""
    writer = RecordingWriter(path)
    for topic, message in messages:
        writer.add(topic, dict(message))  # The writer may modify the map.
    writer.close()
    return Recording(path)


def record_hand(
    path: Path,
    due: dict[int, dict[str, Any]],
    seconds: float,
    changes: tuple[str, ...] = (),
    profile: str | None = None,
    hand: tuple[str, ...] = (),
) -> list[str]:
    """Record a run; ``due`` maps ticks (500 per second) to the commands sent at these ticks.

    ``hand`` contains settings that apply only to the simulated hand, not to the daemon. Returns the
    reason for each refused command.
    """
    refused = []
    with VirtualHand(profile, changes, hand) as made, made.record(path):
        start = made.t
        for tick, request in due.items():
            made.run(start + (tick - 1) * TICK - made.t)
            numbers = {name: value for name, value in request.items() if name != "command"}
            try:
                made.command(request["command"], **numbers)
            except Refused as refusal:
                refused.append(str(refusal))
        made.run(start + seconds - made.t)
    return refused
