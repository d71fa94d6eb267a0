"""Define the interface of tactile backends; create the selected backend."""

from __future__ import annotations

from typing import Protocol

from softfinger.daemon.backends import backend
from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame

__all__ = ["TactileSensor"]


class TactileSensor(Protocol):
    """Pressure sensor under one fingertip. The sensor is read outside the control tick."""

    def open(self) -> None:
        """Open the sensor and wait for a valid frame. Raises TactileError if no frame arrives."""

    def latest(self) -> Frame | None:
        """Return the newest complete frame, or None before the first frame.

        The same object is returned until a newer frame arrives.
        """

    def counters(self) -> dict[str, int]:
        """Return counts since `open` was called: ``frames``, ``resyncs``, ``skipped_bytes``, …"""

    def close(self) -> None:
        """Stop reading and close the sensor. Never raises."""


def make_sensor(
    settings: Settings, clock: Clock, hand: object, finger: int
) -> TactileSensor | None:
    """Create a finger's tactile backend without opening it.

    Returns None if the scene has no sensors.

    ``hand`` is the simulated hand, which some backends use. Raises the same errors as the backend's
    constructor.
    """
    found = backend("tactile", settings.tactile.backend)
    if settings.tactile.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings.tactile,)
    options = found.options(settings.plugins.tables)
    sensor: TactileSensor = found.load()(*scene, clock, finger, *options)
    return sensor
