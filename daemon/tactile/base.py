"""The interface of every tactile backend, and the one that settings name."""

from __future__ import annotations

from typing import Protocol

from softfinger.daemon.backends import backend
from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame


class TactileSensor(Protocol):
    """The pressure grid under one fingertip. Reading runs outside the tick."""

    def open(self) -> None:
        """Open the sensor and wait for a first good frame. Raises TactileError if none comes."""

    def latest(self) -> Frame | None:
        """Return the newest complete frame, the same object until a newer one; None before any."""

    def counters(self) -> dict[str, int]:
        """Return counts since open: ``frames``, ``resyncs``, ``skipped_bytes``, …"""

    def close(self) -> None:
        """Stop reading and close. Never raises."""


def make_sensor(
    settings: Settings, clock: Clock, hand: object, finger: int
) -> TactileSensor | None:
    """Make the settings' backend for one finger, not yet open; None in a scene without sensors.

    ``hand``: the simulated hand, for backends that need it. Raises as the backend does.
    """
    found = backend("tactile", settings.tactile.backend)
    if settings.tactile.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings.tactile,)
    options = found.options(settings.plugins.tables)
    sensor: TactileSensor = found.load()(*scene, clock, finger, *options)
    return sensor
