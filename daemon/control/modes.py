"""The hand's modes and commands, and which command is accepted in which mode."""

from __future__ import annotations

from enum import StrEnum


class Mode(StrEnum):
    """Mode of the hand."""

    DISARMED = "disarmed"  # torque off
    ARMED = "armed"  # torque on, joints hold where they are
    MOVING = "moving"  # joints on their way to commanded angles
    GRASPING = "grasping"  # closing, or building up the force
    HOLDING = "holding"  # force and object's angle held
    ROTATING = "rotating"  # turning the object in the grip
    RELEASING = "releasing"  # opening
    FAULT = "fault"  # torque off until the fault is cleared


GRIPPING = frozenset({Mode.GRASPING, Mode.HOLDING, Mode.ROTATING})
HELD = frozenset({Mode.HOLDING, Mode.ROTATING})

_ON = frozenset(Mode) - {Mode.DISARMED, Mode.FAULT}
_ANY = frozenset(Mode)

# command → (modes in which it is accepted, its numbers: name → required)
COMMANDS: dict[str, tuple[frozenset[Mode], dict[str, bool]]] = {
    "arm": (frozenset({Mode.DISARMED}), {}),
    "disarm": (_ANY - {Mode.FAULT}, {}),
    "tare": (frozenset({Mode.DISARMED, Mode.ARMED}), {}),
    "move": (frozenset({Mode.ARMED, Mode.MOVING}), {"left": False, "right": False}),
    "grasp": (
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING,
        {"force": False},
    ),
    "rotate": (GRIPPING, {"angle": True}),  # waits for the grip to hold
    "hold": (  # setpoints of a stream; leaves a grip in its mode
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING,
        {"force": False, "angle": False},
    ),
    "release": (_ON, {}),
    "set": (_ON, {"compliance": True}),
    "demo": (frozenset({Mode.DISARMED}), {}),  # begins the profile's task again
    "stop": (_ANY, {}),
    "clear": (frozenset({Mode.FAULT}), {}),
    "status": (_ANY, {}),
}

# These never stiffen or move the hand, so they may be carried out although they are some time old.
HARMLESS = frozenset({"disarm", "tare", "clear"})
