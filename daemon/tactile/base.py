"""The interface of every tactile backend, and its errors."""

from __future__ import annotations

from typing import Protocol

from softfinger.daemon.types import Frame


class TactileSensor(Protocol):
    """The pressure grid under one fingertip. Reading runs outside the tick."""

    def open(self) -> None:
        """Open the sensor and wait for a first good frame. Raises TactileError if none comes."""

    def latest(self) -> Frame | None:
        """The newest complete frame, None before the first; the same object until a newer one."""

    def counters(self) -> dict[str, int]:
        """What went by or went wrong since open: ``frames``, ``resyncs``, ``skipped_bytes``, …"""

    def close(self) -> None:
        """Stop reading and close. Never raises."""
