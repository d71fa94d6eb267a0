"""Servo backends by name. A backend's module is imported when a scene asks for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softfinger.daemon.loop.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Servos

if TYPE_CHECKING:
    from softfinger.daemon.simulation.physics.hand import SimulatedHand


def make_servos(settings: Settings, clock: Clock, hand: SimulatedHand | None) -> Servos | None:
    """The settings' backend, not yet connected; None when the scene has no servos."""
    backend = settings.servos.backend
    if backend == "simulated":
        from softfinger.daemon.servos.simulated import SimulatedServos

        assert hand is not None
        return SimulatedServos(settings, hand, clock)
    if backend == "dynamixel":
        from softfinger.daemon.servos.dynamixel import DynamixelServos

        return DynamixelServos(settings, clock)
    return None
