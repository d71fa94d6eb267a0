"""Look up servo, tactile and shape backends by name, and import them on demand.

`BUILT_IN` lists the built-in backends. A plugin is an entry point that an installed package defines
in the group ``softfinger.servos``, ``softfinger.tactile`` or ``softfinger.shapes``. Servo and
tactile plugins are classes, and shape plugins are functions. Plugins take the same arguments as the
built-in backends. A plugin may define these attributes:

- ``metal``: True (default) if the backend drives real hardware.
- ``hand``: True if the plugin needs the simulated hand. The daemon then passes the simulated hand
  to the plugin, as it does to the simulated backends. Instead of True, a servo plugin may specify a
  class that replaces `SimulatedHand` and takes the same arguments.
- ``Settings``: a pydantic model for the profile table ``[plugins.NAME]``, preferably derived from
  `profile.fields.Section`. The daemon passes the validated settings as the last argument.
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
    """Function that loads a backend, and the backend's requirements."""

    load: Callable[[], Any]
    metal: bool = True  # True for real hardware
    hand: Any = False  # True, or the class of the hand, if a simulated hand is needed
    name: str = ""  # plugin name, or empty for a built-in backend
    source: str = ""  # plugin name, package and version, used in messages
    section: type[BaseModel] | None = None  # plugin's settings model

    def options(self, tables: Mapping[str, Any]) -> tuple[BaseModel, ...]:
        """Return a tuple with the plugin's validated settings, or an empty tuple."""
        if self.section is None:
            return ()
        return (self.section.model_validate(tables.get(self.name, {})),)


def _built_in(place: str, metal: bool = True, hand: bool = False) -> Backend:
    module, _, name = f"softfinger.daemon.{place}".partition(":")
    return Backend(lambda: getattr(import_module(module), name), metal, hand)


_NONE = Backend(lambda: None, metal=False)
_SHAPES = "simulation.physics.shapes"
_SIMULATED_TACTILE = "simulation.simulated_tactile:SimulatedTactile"
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
    """Return the backend called ``name``.

    Raises KeyError if the name is unknown, and PluginError if the plugin is unusable.
    """
    return BUILT_IN[kind].get(name) or _plugin(kind, name)


def needs_hand(servos: str, tactile: str) -> bool:
    """Return True if the named servo or tactile backend needs the simulated hand."""
    return bool(backend("servos", servos).hand or backend("tactile", tactile).hand)


def known(kind: Kind) -> list[str]:
    """Return the names of all backends of one kind, built-in backends first."""
    return list(dict.fromkeys([*BUILT_IN[kind], *(entry.name for entry in plugins(kind))]))


def plugins(kind: Kind) -> list[EntryPoint]:
    """Return the entry points of one kind, without duplicates."""
    from importlib.metadata import entry_points  # slow import, rarely needed

    return list(dict.fromkeys(entry_points(group=f"softfinger.{kind}")))


def source(entry: EntryPoint) -> str:
    """Return the plugin's name, followed by the name and the version of its package."""
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "no package"
    return f"plugin {entry.name} from {package}"


@cache
def _plugin(kind: Kind, name: str) -> Backend:
    entries = [entry for entry in plugins(kind) if entry.name == name]
    if not entries:
        raise KeyError(name)
    if len(entries) > 1:
        raise PluginError(
            f"{' and '.join(map(source, entries))} have the same name; uninstall one of them"
        )
    (entry,) = entries
    try:
        made = entry.load()
    except Exception as error:  # A plugin may raise any exception.
        why = f"{type(error).__name__}: {error}"
        raise PluginError(f"{source(entry)} can't be loaded: {why}") from error
    metal, hand = getattr(made, "metal", True), getattr(made, "hand", False)
    return Backend(entry.load, metal, hand, name, source(entry), getattr(made, "Settings", None))


def servo_model(name: str) -> Any:
    """Return the `ServoModel` called ``name``. Raises KeyError like `control_table.by_name`."""
    return import_module("softfinger.daemon.servos.control_table").by_name(name)
