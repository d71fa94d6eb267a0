"""The hand's modes, the commands, and the one table that says which command is heard in which mode.

Checks a command's form and bounds; what it then does is the control law's business.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from softfinger.daemon.errors import Refused


class Mode(StrEnum):
    """What the hand is doing."""

    DISARMED = "disarmed"  # torque off
    ARMED = "armed"  # torque on, joints hold where they are
    MOVING = "moving"  # joints on their way to commanded angles
    GRASPING = "grasping"  # closing, or building up the force
    HOLDING = "holding"  # force and object's angle held
    ROTATING = "rotating"  # turning the object in the grip
    RELEASING = "releasing"  # opening
    FAULT = "fault"  # torque off until the fault is cleared


_ON = frozenset(Mode) - {Mode.DISARMED, Mode.FAULT}
_GRIPPED = frozenset({Mode.HOLDING, Mode.ROTATING})
_ANY = frozenset(Mode)

# command → (modes in which it is heard, its numbers: name → required)
COMMANDS: dict[str, tuple[frozenset[Mode], dict[str, bool]]] = {
    "arm": (frozenset({Mode.DISARMED}), {}),
    "disarm": (_ANY - {Mode.FAULT}, {}),
    "tare": (frozenset({Mode.DISARMED, Mode.ARMED}), {}),
    "move": (frozenset({Mode.ARMED, Mode.MOVING}), {"left": False, "right": False}),
    "grasp": (
        frozenset({Mode.ARMED, Mode.MOVING, Mode.GRASPING}) | _GRIPPED,
        {"force": False},
    ),
    "rotate": (_GRIPPED | {Mode.GRASPING}, {"angle": True}),  # waits for the grip to hold
    "release": (_ON, {}),
    "set": (_ON, {"compliance": True}),
    "stop": (_ANY, {}),
    "clear": (frozenset({Mode.FAULT}), {}),
    "status": (_ANY, {}),
}

_ENVELOPE = frozenset({"command", "client"})
_FIRST = {
    Mode.DISARMED: "arm first",
    Mode.FAULT: "clear the fault first",
}


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the right form, heard in the present mode."""

    name: str
    numbers: dict[str, float]
    client: str


def parse(request: dict[str, Any], mode: Mode) -> Command:
    """Check a decoded request against the table. Raises Refused with found and expected."""
    name = request["command"]
    if name not in COMMANDS:
        raise Refused(f"unknown command {name[:40]!r}; known: {', '.join(COMMANDS)}")
    if name == "stop":  # which stops, whatever else the message holds
        return Command(name, {}, "")
    client = request.get("client", "")
    if not isinstance(client, str) or len(client) > 64:
        raise Refused("client: expected a text of at most 64 characters")
    heard, parameters = COMMANDS[name]
    unknown = sorted(set(request) - _ENVELOPE - set(parameters))
    if unknown:
        known = ", ".join(parameters) or "no parameters"
        raise Refused(f"{name}: unknown parameter {unknown[0][:40]!r}; expected {known}")
    numbers = {}
    for key, required in parameters.items():
        if key in request:
            numbers[key] = _number(name, key, request[key])
        elif required:
            raise Refused(f"{name}: {key} is missing")
    if mode not in heard:
        hint = _FIRST.get(mode) or f"possible while {', '.join(sorted(heard))}"
        raise Refused(f"{name}: not while {mode.value}; {hint}")
    return Command(name, numbers, client)


def _number(name: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Refused(f"{name}: {key}: expected a number, found {type(value).__name__}")
    if not math.isfinite(value):
        raise Refused(f"{name}: {key}: expected a finite number, found {value}")
    return float(value)


class Lease:
    """One commander at a time: a client keeps the hand for a while after its last command.

    Clients that give no name share one. What can only make the hand safer needs no lease.
    """

    FREE = frozenset({"stop", "disarm", "status"})

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._owner = ""
        self._until = -math.inf

    def check(self, command: Command, now: float) -> None:
        """Raises Refused while somebody else has the lease."""
        if command.name in self.FREE:
            return
        if now < self._until and command.client != self._owner:
            owner = self._owner or "an unnamed client"
            raise Refused(f"{command.name}: {owner} commands the hand ({self._until - now:.1f} s)")

    def renew(self, command: Command, now: float) -> None:
        """Take or prolong the lease, once the command has been carried out."""
        if command.name not in self.FREE:
            self._owner = command.client
            self._until = now + self._seconds
