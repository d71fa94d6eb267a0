"""Backends by name: what serves each name of the settings, imported when a scene needs it.

Built-in ones are entries of a dict; others are entry points of installed packages, in the groups
``softfinger.servos``, ``softfinger.tactile`` and ``softfinger.shapes``. A plugin is a class (a
function for a shape) that is called as the built-in ones are. It may have

- ``metal``: it is real hardware (True unless it says otherwise),
- ``hand``: it needs the simulated hand, which it then is given as the built-in ones are; servos
  may name the class that is made in the place of `SimulatedHand`, with its arguments,
- ``Settings``: a pydantic model, best derived from `profile.fields.Section`, of the profile's
  table ``[plugins.NAME]``; the validated settings are its last argument.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from softfinger.daemon.errors import PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from pydantic import BaseModel

Kind = Literal["servos", "tactile", "shapes"]


class Backend(NamedTuple):
    """A backend's class, and what it needs beside its settings and the clock."""

    load: Callable[[], Any]
    metal: bool = True  # it drives or reads real hardware
    hand: Any = False  # it needs the simulated hand; of servos also the hand's class
    source: str = ""  # of a plugin: its name, package and version
    section: type[BaseModel] | None = None  # of a plugin: its own settings

    @property
    def name(self) -> str:
        """A plugin's name, empty for a built-in backend."""
        return self.source.partition(" ")[0]

    def options(self, tables: Mapping[str, Any]) -> tuple[BaseModel, ...]:
        """Return the last argument of a plugin with settings, its table validated; else none."""
        if self.section is None:
            return ()
        return (self.section.model_validate(tables.get(self.name, {})),)


def _built_in(place: str, metal: bool = True, hand: bool = False) -> Backend:
    module, _, name = f"softfinger.daemon.{place}".partition(":")
    return Backend(lambda: getattr(import_module(module), name), metal, hand)


_NONE = Backend(lambda: None, metal=False)
_SHAPES = "simulation.physics.shapes"
_SIMULATED_TACTILE = "simulation.sensor.simulated_tactile:SimulatedTactile"
BUILT_IN: dict[Kind, dict[str, Backend]] = {
    "servos": {
        "simulated": _built_in("servos.simulated:SimulatedServos", metal=False, hand=True),
        "dynamixel": _built_in("servos.dynamixel:DynamixelServos"),
        "none": _NONE,
    },
    "tactile": {
        "simulated": _built_in(_SIMULATED_TACTILE, metal=False, hand=True),
        "flexitac": _built_in("tactile.flexitac:FlexiTac"),
        "glove": _built_in("tactile.glove:Glove"),
        "cobs": _built_in("tactile.cobs:Cobs"),
        "replay": _built_in("tactile.replay:ReplayTactile", metal=False),
        "none": _NONE,
    },
    "shapes": {  # of the simulated object
        "rectangle": _built_in(f"{_SHAPES}:rectangle"),
        "disc": _built_in(f"{_SHAPES}:disc"),
        "wedge": _built_in(f"{_SHAPES}:wedge"),
        "none": _built_in(f"{_SHAPES}:nothing"),
    },
}


def backend(kind: Kind, name: str) -> Backend:
    """Return the backend of that name.

    Raises KeyError where there is none, PluginError where it can't be used.
    """
    return BUILT_IN[kind].get(name) or _plugin(kind, name)


def needs_hand(servos: str, tactile: str) -> bool:
    """Return whether servos or sensors of those names are parts of the simulated hand."""
    return bool(backend("servos", servos).hand or backend("tactile", tactile).hand)


def known(kind: Kind) -> list[str]:
    """Return the names of a kind, the built-in ones first."""
    return list(dict.fromkeys([*BUILT_IN[kind], *(entry.name for entry in plugins(kind))]))


def plugins(kind: Kind) -> list[EntryPoint]:
    """Return the entry points of a kind, each once."""
    from importlib.metadata import entry_points  # takes its time, and few scenes need it

    return list(dict.fromkeys(entry_points(group=f"softfinger.{kind}")))


def source(entry: EntryPoint) -> str:
    """Return a plugin's name with the package it comes from."""
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "no package"
    return f"{entry.name} of {package}"


@cache
def _plugin(kind: Kind, name: str) -> Backend:
    entries = [entry for entry in plugins(kind) if entry.name == name]
    if not entries:
        raise KeyError(name)
    if len(entries) > 1:
        raise PluginError(f"{' and '.join(map(source, entries))} have the same name")
    (entry,) = entries
    try:
        made = entry.load()
    except Exception as error:  # whatever a stranger's module does
        why = f"{type(error).__name__}: {error}"
        raise PluginError(f"{source(entry)} fails to load: {why}") from error
    metal, hand = getattr(made, "metal", True), getattr(made, "hand", False)
    return Backend(entry.load, metal, hand, source(entry), getattr(made, "Settings", None))


def known_servo_models(name: str) -> str:
    """Return an empty text for a servo model with a control table, else the names of all."""
    table = import_module("softfinger.daemon.servos.control_table")
    try:
        table.by_name(name)
    except KeyError:
        return ", ".join(table.MODELS)
    return ""
