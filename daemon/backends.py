"""Backends by name: what serves each name of the settings, imported when a scene asks for it.

Built-in ones are lines of the tables below. Others come from installed packages, by entry points
of the groups named there; `daemon.plugins` guards them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from softfinger.daemon.errors import PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from pydantic import BaseModel

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
    source: str = ""  # of a plugin: its name, package and version
    section: type[BaseModel] | None = None  # likewise: its own settings
    shape: bool = False

    def load(self) -> Any:
        module, _, name = self.place.partition(":")
        return attrgetter(name)(import_module(module))

    def options(self, settings: Settings) -> tuple[BaseModel, ...]:
        """A plugin's own settings, its last argument; none where it has none."""
        if self.section is None:
            return ()
        return (self.section.model_validate(settings.plugins.of(self.name)),)

    @property
    def name(self) -> str:
        """A plugin's name."""
        return self.source.partition(" ")[0]


class Backends(Mapping[str, Backend]):
    """Those of one kind. A name that isn't built in is looked for among the installed packages.

    Asking for one raises KeyError where there is none, and PluginError where it can't be used.
    """

    def __init__(self, group: str, built_in: dict[str, Backend]) -> None:
        self.group = group  # of entry points
        self._known = built_in

    def __getitem__(self, name: str) -> Backend:
        if name not in self._known:
            self._known[name] = _find(self.group, name)
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter([*self._known, *(set(installed(self.group)) - set(self._known))])

    def __len__(self) -> int:
        return len(list(iter(self)))


def installed(group: str) -> dict[str, list[EntryPoint]]:
    """The entry points of a group by name; more than one where packages disagree."""
    from importlib.metadata import entry_points  # takes its time, and few scenes need it

    found: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=group):
        if entry not in found.setdefault(entry.name, []):
            found[entry.name].append(entry)
    return found


def _find(group: str, name: str) -> Backend:
    """The backend of that name. Raises KeyError, and PluginError where it can't be used."""
    entries = installed(group)[name]
    if len(entries) > 1:
        raise PluginError(f"{' and '.join(map(source, entries))} have the same name")
    (entry,) = entries
    try:
        made = entry.load()
    except Exception as error:  # whatever a stranger's module does
        raise PluginError(
            f"{source(entry)} fails to load: {type(error).__name__}: {error}"
        ) from error
    if not callable(made):
        raise PluginError(f"{source(entry)}: found {made!r}, expected a class or a function")
    shape = group == _SHAPES
    metal = not shape and bool(getattr(made, "metal", True))
    hand = bool(getattr(made, "hand", False))
    section = getattr(made, "Settings", None)
    place = f"{entry.module}:{entry.attr}"
    return Backend(place, metal, hand, source(entry), section, shape)


def source(entry: EntryPoint) -> str:
    """A plugin's name with the package it comes from."""
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "no package"
    return f"{entry.name} of {package}"


def _built_in(place: str, metal: bool = True, hand: bool = False) -> Backend:
    return Backend(f"softfinger.daemon.{place}", metal, hand)


_SHAPES = "softfinger.shapes"  # the group whose plugins are functions, and never metal
NONE = Backend("", metal=False)  # the scene has no servos, or no sensors

SERVOS = Backends(
    "softfinger.servos",
    {
        "simulated": _built_in("servos.simulated:SimulatedServos", metal=False, hand=True),
        "dynamixel": _built_in("servos.dynamixel:DynamixelServos"),
        "none": NONE,
    },
)
TACTILE = Backends(
    "softfinger.tactile",
    {
        "simulated": _built_in(
            "simulation.sensor.simulated_tactile:SimulatedTactile", metal=False, hand=True
        ),
        "flexitac": _built_in("tactile.flexitac:FlexiTac"),
        "glove": _built_in("tactile.glove:Glove"),
        "cobs": _built_in("tactile.cobs:Cobs"),
        "replay": _built_in("tactile.replay:ReplayTactile", metal=False),
        "none": NONE,
    },
)
SHAPES = Backends(  # of the simulated object
    _SHAPES,
    {
        "rectangle": _built_in("simulation.physics.shapes:rectangle", metal=False),
        "disc": _built_in("simulation.physics.shapes:disc", metal=False),
        "wedge": _built_in("simulation.physics.shapes:wedge", metal=False),
        "none": _built_in("simulation.physics.shapes:nothing", metal=False),
    },
)
KINDS = (SERVOS, TACTILE, SHAPES)


def used(settings: Settings) -> dict[str, Backend]:
    """The settings' backends, by the key that names each."""
    return {
        "servos.backend": SERVOS[settings.servos.backend],
        "tactile.backend": TACTILE[settings.tactile.backend],
        "simulation.object_shape": SHAPES[settings.simulation.object_shape],
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
    """The settings' servo backend, not yet connected; None when the scene has no servos.

    Raises ServoError where a plugin can't be made.
    """
    backend = SERVOS[settings.servos.backend]
    if backend is NONE:
        return None
    plant = (hand,) if backend.hand else ()
    given = (settings, *plant, clock, *backend.options(settings))
    if backend.source:
        from softfinger.daemon.plugins import GuardedServos

        return GuardedServos(backend, given)
    servos: Servos = backend.load()(*given)
    return servos


def make_sensor(
    settings: Settings, clock: Clock, hand: SimulatedHand | None, finger: int
) -> TactileSensor | None:
    """The settings' tactile backend for one finger, not yet open; None in a scene without.

    Raises TactileError where a plugin can't be made.
    """
    backend = TACTILE[settings.tactile.backend]
    if backend is NONE:
        return None
    scene = (settings, hand) if backend.hand else (settings.tactile,)
    given = (*scene, clock, finger, *backend.options(settings))
    if backend.source:
        from softfinger.daemon.plugins import GuardedSensor

        return GuardedSensor(backend, given, settings.tactile.rows, settings.tactile.cols)
    sensor: TactileSensor = backend.load()(*given)
    return sensor
