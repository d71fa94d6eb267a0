"""Modes and commands of the hand, and the modes in which each command is accepted."""

from __future__ import annotations

from enum import StrEnum


class Mode(StrEnum):
    """Mode of the hand."""

    DISARMED = "disarmed"  # torque off
    ARMED = "armed"  # torque on, joints hold their positions
    MOVING = "moving"  # joints moving to commanded angles
    GRASPING = "grasping"  # closing, or increasing the force
    HOLDING = "holding"  # holding force and object angle
    ROTATING = "rotating"  # rotating the object
    RELEASING = "releasing"  # opening the fingers
    FAULT = "fault"  # torque off until the fault is cleared


GRIPPING_MODES = frozenset({Mode.GRASPING, Mode.HOLDING, Mode.ROTATING})
HOLDING_MODES = frozenset({Mode.HOLDING, Mode.ROTATING})

_TORQUE_MODES = frozenset(Mode) - {Mode.DISARMED, Mode.FAULT}
_ALL_MODES = frozenset(Mode)

# Command → (modes in which it is accepted, numeric argument → True if required).
COMMANDS: dict[str, tuple[frozenset[Mode], dict[str, bool]]] = {
    "arm": (frozenset({Mode.DISARMED}), {}),
    "disarm": (_ALL_MODES - {Mode.FAULT}, {}),
    "tare": (frozenset({Mode.DISARMED, Mode.ARMED}), {}),
    "move": (frozenset({Mode.ARMED, Mode.MOVING}), {"left": False, "right": False}),
    "grasp": (
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        {"force": False},
    ),
    "rotate": (GRIPPING_MODES, {"angle": True}),  # starts once the grip holds
    "hold": (  # streamed setpoints; the mode of a grip stays the same
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        {"force": False, "angle": False},
    ),
    "release": (_TORQUE_MODES, {}),
    "set": (_TORQUE_MODES, {"compliance": True}),
    "demo": (frozenset({Mode.DISARMED}), {}),  # restarts the profile's task
    "stop": (_ALL_MODES, {}),
    "clear": (frozenset({Mode.FAULT}), {}),
    "status": (_ALL_MODES, {}),
}

# These commands never stiffen or move the hand, so they are accepted even if they arrive late.
SAFE_COMMANDS = frozenset({"disarm", "tare", "clear"})
