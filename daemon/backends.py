"""Backends by name: what serves each name of the settings, imported when a scene asks for it.

A new servo backend, tactile board or object is a line here and a class or function of its own.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from softfinger.daemon.clock import Clock
    from softfinger.daemon.profile.settings import Settings
    from softfinger.daemon.servos.base import Servos
    from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
    from softfinger.daemon.tactile.base import TactileSensor


class Backend(NamedTuple):
    """Where a backend's class stands, and what it needs beside its settings and the clock."""

    place: str  # module:class or function
    metal: bool = True  # it drives or reads real hardware
    hand: bool = False  # it needs the simulated hand

    def load(self) -> Any:
        module, _, name = self.place.partition(":")
        return getattr(import_module(f"softfinger.daemon.{module}"), name)


NONE = Backend("", metal=False)  # the scene has no servos, or no sensors

SERVOS = {
    "simulated": Backend("servos.simulated:SimulatedServos", metal=False, hand=True),
    "dynamixel": Backend("servos.dynamixel:DynamixelServos"),
    "none": NONE,
}
TACTILE = {
    "simulated": Backend("simulation.sensor.simulated_tactile:SimulatedTactile", False, hand=True),
    "flexitac": Backend("tactile.flexitac:FlexiTac"),
    "glove": Backend("tactile.glove:Glove"),
    "cobs": Backend("tactile.cobs:Cobs"),
    "replay": Backend("tactile.replay:ReplayTactile", metal=False),
    "none": NONE,
}
SHAPES = {  # of the simulated object
    name: Backend(f"simulation.physics.shapes:{function}", metal=False)
    for name, function in (
        ("rectangle", "rectangle"),
        ("disc", "disc"),
        ("wedge", "wedge"),
        ("none", "nothing"),
    )
}


def known_servo_models(name: str) -> str:
    """Empty for a servo model that has a control table, else the names of those that have."""
    table = import_module("softfinger.daemon.servos.control_table")
    try:
        table.by_name(name)
    except KeyError:
        return ", ".join(table.MODELS)
    return ""


def make_servos(settings: Settings, clock: Clock, hand: SimulatedHand | None) -> Servos | None:
    """The settings' servo backend, not yet connected; None when the scene has no servos."""
    backend = SERVOS[settings.servos.backend]
    if backend is NONE:
        return None
    plant = (hand,) if backend.hand else ()
    servos: Servos = backend.load()(settings, *plant, clock)
    return servos


def make_sensor(
    settings: Settings, clock: Clock, hand: SimulatedHand | None, finger: int
) -> TactileSensor | None:
    """The settings' tactile backend for one finger, not yet open; None in a scene without."""
    backend = TACTILE[settings.tactile.backend]
    if backend is NONE:
        return None
    given = (settings, hand) if backend.hand else (settings.tactile,)
    sensor: TactileSensor = backend.load()(*given, clock, finger)
    return sensor
