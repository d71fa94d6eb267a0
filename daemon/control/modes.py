"""Define the hand's modes and commands. The commands page is generated from `COMMANDS`."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

from softfinger.daemon.errors import Reason


class Mode(StrEnum):
    """Mode of the hand."""

    DISARMED = "disarmed"  # torque off
    ARMED = "armed"  # torque on; the joints hold their positions
    MOVING = "moving"  # the joints move to the commanded angles
    GRASPING = "grasping"  # the fingers close or the grip force increases
    HOLDING = "holding"  # the grip force and the object angle are held
    ROTATING = "rotating"  # the object is being rotated
    RELEASING = "releasing"  # the fingers open
    FAULT = "fault"  # torque off until the fault is cleared


GRIPPING_MODES = frozenset({Mode.GRASPING, Mode.HOLDING, Mode.ROTATING})
HOLDING_MODES = frozenset({Mode.HOLDING, Mode.ROTATING})

_TORQUE_MODES = frozenset(Mode) - {Mode.DISARMED, Mode.FAULT}
_ALL_MODES = frozenset(Mode)


class Parameter(NamedTuple):
    """Numeric parameter of a command. `loop.requests.bounds` returns the allowed range."""

    required: bool
    unit: str
    range: str  # range as text, with the names of the settings that define the range
    meaning: str


_NONE: Mapping[Any, Any] = MappingProxyType({})


class CommandKind(NamedTuple):
    """Description of a command and of the modes in which the hand accepts the command.

    ``reply`` lists the reply fields other than ``mode``; `REPLY` explains all fields. ``refusals``
    maps reasons for a refusal to causes that are specific to this command.
    """

    modes: frozenset[Mode]
    action: str
    parameters: Mapping[str, Parameter] = _NONE
    reply: tuple[str, ...] = ()
    refusals: Mapping[Reason, str] = _NONE


# Meanings of the reply fields.
REPLY = {
    "mode": "mode after the command",
    "torque_off": "`confirmed`, or `unconfirmed` if a servo has not replied yet",
    "warning": "warning, for example if the object is outside the [envelope](envelope.md)",
    "angle": "target angle of the object [rad], limited to the range of this grip",
    "queued": "name of the command if it must wait for the mode in `until`",
    "until": "mode in which the queued command starts",
    "fault": "reason for the latched fault, or empty",
    "fault_name": "name of the fault in [Limits](limits.md), or empty",
    "torque": "torque is on, or torque off is not confirmed",
    "seq": "number of the current tick",
    "overruns": "number of ticks that took longer than the period",
    "counters": "counters of the servos and of each sensor",
    "limited": "number of ticks in which the goal was limited, for each limit",
}

_JOINT = Parameter(False, "rad", "`hand.q_min` to `hand.q_max`", "target angle of this joint")
_FORCE = Parameter(
    False,
    "N",
    "above `control.contact_force`, up to 0.9 × `safety.force_max`",
    "normal force of each tip; default: `control.force_default`",
)
_QUEUED = ("queued", "until")
_GRIP_REFUSALS = {
    Reason.BOUNDS: "The force or the angle is out of range.",
    Reason.SCENE: "The scene has no tactile sensors, `servos.mode` is `position`, or an angle is "
    "given although the scene has only one finger or no object model.",
    Reason.STATE: "A limit is exceeded, a tare is in progress, or the object's angle is unknown.",
}

COMMANDS: dict[str, CommandKind] = {
    "arm": CommandKind(
        frozenset({Mode.DISARMED}),
        "Switches torque on. The joints hold their positions.",
        refusals={
            Reason.SCENE: "The scene has no servos.",
            Reason.STATE: "A limit is exceeded, or the servos have not confirmed torque off.",
            Reason.LATE: "The servos did not reply within this tick.",
        },
    ),
    "disarm": CommandKind(
        _ALL_MODES - {Mode.FAULT},
        "Switches torque off. A held object falls.",
        reply=("torque_off",),
    ),
    "tare": CommandKind(
        frozenset({Mode.DISARMED, Mode.ARMED}),
        "Sets the zero offset of each cell to the mean of its next readings. The tips must be "
        "free.",
        refusals={
            Reason.SCENE: "The scene has no tactile sensors.",
            Reason.STATE: "A tip is in contact.",
        },
    ),
    "move": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}),
        "Moves one or both joints.",
        {"left": _JOINT, "right": _JOINT},
        refusals={
            Reason.REQUEST: "Neither joint is given.",
            Reason.BOUNDS: "An angle is out of range.",
            Reason.SCENE: "The scene does not have this finger.",
        },
    ),
    "grasp": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        "Closes the fingers until both tips are in contact, then presses with the given force. "
        "If the hand is already gripping, only the force changes.",
        {"force": _FORCE},
        ("warning",),
        {
            Reason.BOUNDS: "The force is out of range.",
            Reason.SCENE: "The scene has no tactile sensors, or `servos.mode` is `position`.",
            Reason.STATE: "A limit is exceeded, or a tare is in progress.",
        },
    ),
    "rotate": CommandKind(
        GRIPPING_MODES,
        "Rotates the grasped object at `control.rotate_speed`. If the hand is still grasping, "
        "the rotation starts when the grip has settled.",
        {"angle": Parameter(True, "rad", "range of the grip", "angle in the hand's frame")},
        _QUEUED,
        {
            Reason.BOUNDS: "The angle is outside the range of this grip. The error text states the "
            "range.",
            Reason.SCENE: "The scene has only one finger or no object model.",
            Reason.STATE: "The object's angle is unknown.",
        },
    ),
    "hold": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        "Follows setpoints that a program streams at 50 to 100 Hz. The first setpoint starts a "
        "grasp, unless the hand is already gripping.",
        {
            "force": _FORCE._replace(
                meaning="normal force of each tip; if it is omitted during a grip, the force does "
                "not change"
            ),
            "angle": Parameter(
                False, "rad", "limited to the range of this grip", "angle in the hand's frame"
            ),
        },
        ("angle", *_QUEUED, "warning"),
        _GRIP_REFUSALS | {Reason.REQUEST: "Both force and angle are missing."},
    ),
    "release": CommandKind(_TORQUE_MODES, "Opens the fingers to `hand.open_angle`."),
    "set": CommandKind(
        _TORQUE_MODES,
        "Sets a property of the grip until the daemon exits.",
        {
            "compliance": Parameter(
                True,
                "rad/(N·m)",
                "",
                "rotation per unit torque on the object, 1 / `control.joint_stiffness`",
            )
        },
        refusals={Reason.BOUNDS: "The compliance is out of range."},
    ),
    "demo": CommandKind(
        frozenset({Mode.DISARMED}),
        "Arms the hand and restarts the profile's task (`task.name`).",
        refusals={Reason.SCENE: "The profile does not define a task."},
    ),
    "stop": CommandKind(
        _ALL_MODES,
        "Switches torque off immediately. Commands that are still waiting are rejected as "
        "`stopped`. `stop` itself is always accepted, even if the message contains unknown "
        "fields.",
        reply=("torque_off",),
    ),
    "clear": CommandKind(
        frozenset({Mode.FAULT}),
        "Clears a fault whose cause has been removed, and reconnects the servos and sensors. The "
        "hand is then disarmed.",
        refusals={
            Reason.STATE: "The cause persists, or the servos or a sensor do not respond.",
        },
    ),
    "status": CommandKind(
        _ALL_MODES,
        "Returns the daemon's state.",
        reply=("fault", "fault_name", "torque", "seq", "overruns", "counters", "limited"),
    ),
}

# The age limit is higher for these commands, which never stiffen or move the hand.
SAFE_COMMANDS = frozenset({"disarm", "tare", "clear"})
