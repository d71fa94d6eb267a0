"""Tactile backends by name. A backend's module is imported when a scene asks for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softfinger.daemon.loop.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.base import TactileSensor

if TYPE_CHECKING:
    from softfinger.daemon.simulation.physics.hand import SimulatedHand


def make_sensor(
    settings: Settings, clock: Clock, hand: SimulatedHand | None, finger: int
) -> TactileSensor | None:
    """The settings' backend for one finger, not yet open; None when the scene has no sensors."""
    backend = settings.tactile.backend
    if backend == "simulated":
        from softfinger.daemon.tactile.simulated import SimulatedTactile

        assert hand is not None
        return SimulatedTactile(settings, hand, clock, finger)
    if backend == "flexitac":
        from softfinger.daemon.tactile.flexitac import FlexiTac

        return FlexiTac(settings.tactile, clock, finger)
    if backend == "glove":
        from softfinger.daemon.tactile.glove import Glove

        return Glove(settings.tactile, clock, finger)
    if backend == "cobs":
        from softfinger.daemon.tactile.cobs import Cobs

        return Cobs(settings.tactile, clock, finger)
    if backend == "replay":
        from softfinger.daemon.tactile.replay import ReplayTactile

        return ReplayTactile(settings.tactile, clock, finger)
    return None
