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


GRIPPING_MODES = frozenset({Mode.GRASPING, Mode.HOLDING, Mode.ROTATING})
HOLDING_MODES = frozenset({Mode.HOLDING, Mode.ROTATING})

_TORQUE_MODES = frozenset(Mode) - {Mode.DISARMED, Mode.FAULT}
_ALL_MODES = frozenset(Mode)

# command → (modes in which it is accepted, its numeric arguments: name → required)
COMMANDS: dict[str, tuple[frozenset[Mode], dict[str, bool]]] = {
    "arm": (frozenset({Mode.DISARMED}), {}),
    "disarm": (_ALL_MODES - {Mode.FAULT}, {}),
    "tare": (frozenset({Mode.DISARMED, Mode.ARMED}), {}),
    "move": (frozenset({Mode.ARMED, Mode.MOVING}), {"left": False, "right": False}),
    "grasp": (
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        {"force": False},
    ),
    "rotate": (GRIPPING_MODES, {"angle": True}),  # waits for the grip to hold
    "hold": (  # streamed setpoints; does not change the mode of a grip
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        {"force": False, "angle": False},
    ),
    "release": (_TORQUE_MODES, {}),
    "set": (_TORQUE_MODES, {"compliance": True}),
    "demo": (frozenset({Mode.DISARMED}), {}),  # restarts the task of the profile
    "stop": (_ALL_MODES, {}),
    "clear": (frozenset({Mode.FAULT}), {}),
    "status": (_ALL_MODES, {}),
}

# These commands never stiffen or move the hand, so they are accepted even if they arrived late.
SAFE_COMMANDS = frozenset({"disarm", "tare", "clear"})
