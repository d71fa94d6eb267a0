"""Look up servo, tactile and shape backends by name, and import them on demand.

Built-in backends are entries of a dict. Plugins are entry points of installed packages, in the
groups ``softfinger.servos``, ``softfinger.tactile`` and ``softfinger.shapes``. A plugin is a class,
or a function for a shape, with the same arguments as the built-in ones. It may define these
attributes:

- ``metal``: True if it is real hardware, which is the default.
- ``hand``: True if it needs the simulated hand, which is then passed as to the built-in backends. A
  servo plugin may give a class here, which replaces `SimulatedHand` and takes its arguments.
- ``Settings``: a pydantic model of the profile's table ``[plugins.NAME]``, preferably derived from
  `profile.fields.Section`. The validated settings are passed as the last argument.
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
    """Hold a backend's loader and its requirements."""

    load: Callable[[], Any]
    metal: bool = True  # True for real hardware
    hand: Any = False  # True, or for servos the hand's class, if it needs a simulated hand
    source: str = ""  # name, package and version of a plugin
    section: type[BaseModel] | None = None  # settings model of a plugin

    @property
    def name(self) -> str:
        """Name of a plugin, empty for a built-in backend."""
        return self.source.partition(" ")[0]

    def options(self, tables: Mapping[str, Any]) -> tuple[BaseModel, ...]:
        """Return a plugin's validated settings as a tuple of one, empty if it has none."""
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
    "shapes": {  # shapes of the simulated object
        "rectangle": _built_in(f"{_SHAPES}:rectangle"),
        "disc": _built_in(f"{_SHAPES}:disc"),
        "wedge": _built_in(f"{_SHAPES}:wedge"),
        "none": _built_in(f"{_SHAPES}:nothing"),
    },
}


def backend(kind: Kind, name: str) -> Backend:
    """Return the backend with this name.

    Raises KeyError for an unknown name, and PluginError for an unusable plugin.
    """
    return BUILT_IN[kind].get(name) or _plugin(kind, name)


def needs_hand(servos: str, tactile: str) -> bool:
    """Return True if the named servos or sensors are parts of the simulated hand."""
    return bool(backend("servos", servos).hand or backend("tactile", tactile).hand)


def known(kind: Kind) -> list[str]:
    """Return the names of all backends of a kind, built-in ones first."""
    return list(dict.fromkeys([*BUILT_IN[kind], *(entry.name for entry in plugins(kind))]))


def plugins(kind: Kind) -> list[EntryPoint]:
    """Return the entry points of a kind without duplicates."""
    from importlib.metadata import entry_points  # slow to import, and rarely needed

    return list(dict.fromkeys(entry_points(group=f"softfinger.{kind}")))


def source(entry: EntryPoint) -> str:
    """Return a plugin's name with the package that provides it."""
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
    except Exception as error:  # a plugin may raise anything
        why = f"{type(error).__name__}: {error}"
        raise PluginError(f"{source(entry)} fails to load: {why}") from error
    metal, hand = getattr(made, "metal", True), getattr(made, "hand", False)
    return Backend(entry.load, metal, hand, source(entry), getattr(made, "Settings", None))


def servo_model(name: str) -> Any:
    """Return the `ServoModel` of this name. Raises KeyError with the names of all models."""
    table = import_module("softfinger.daemon.servos.control_table")
    try:
        return table.by_name(name)
    except KeyError:
        raise KeyError(", ".join(table.MODELS)) from None
