"""The hand's modes and commands. The documentation page of commands is generated from the table."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

from softfinger.daemon.errors import Reason


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


class Parameter(NamedTuple):
    """Number that a command takes. `loop.requests.bounds` returns its range."""

    required: bool
    unit: str
    range: str  # in words, by the settings that define it
    meaning: str


_NONE: Mapping[Any, Any] = MappingProxyType({})


class CommandKind(NamedTuple):
    """What a command does, when it is accepted, and what its reply contains.

    ``reply`` names the fields beside ``mode``, which `REPLY` explains. ``refusals`` has the causes
    of a refusal that are particular to this command, by the reason in the reply.
    """

    modes: frozenset[Mode]
    action: str
    parameters: Mapping[str, Parameter] = _NONE
    reply: tuple[str, ...] = ()
    refusals: Mapping[Reason, str] = _NONE


# Meanings of the fields in replies.
REPLY = {
    "mode": "mode after the command",
    "torque_off": "`confirmed`, or `unconfirmed` while a servo has not answered yet",
    "warning": "what may fail, for example an object outside of the [envelope](envelope.md)",
    "angle": "angle that the object will reach [rad], limited to the range of the grip",
    "queued": "name of the command, if the hand has to reach the mode in `until` first",
    "until": "mode in which the queued command begins",
    "fault": "reason of the latched fault, or empty",
    "fault_name": "name of the fault in [Limits](limits.md), or empty",
    "torque": "torque is on, or not confirmed to be off",
    "seq": "number of the present tick",
    "overruns": "number of ticks that took longer than the period",
    "counters": "counters of the servos and of each sensor",
    "limited": "number of ticks in which each limit has changed the goal",
}

_JOINT = Parameter(False, "rad", "`hand.q_min` to `hand.q_max`", "target of this joint")
_FORCE = Parameter(
    False,
    "N",
    "above `control.contact_force`, up to 0.9 × `safety.force_max`",
    "normal force of each tip; `control.force_default` if it is not given",
)
_QUEUED = ("queued", "until")
_GRIP_REFUSALS = {
    Reason.BOUNDS: "The force or the angle is outside its range.",
    Reason.SCENE: "The scene lacks tactile sensors, `servos.mode` is `position`, or an angle is "
    "given without two fingers and the object model.",
    Reason.STATE: "A limit is broken, a tare is in progress, or the object's angle is not known.",
}

COMMANDS: dict[str, CommandKind] = {
    "arm": CommandKind(
        frozenset({Mode.DISARMED}),
        "Switches torque on. The joints hold their positions.",
        refusals={
            Reason.SCENE: "The scene has no servos.",
            Reason.STATE: "A limit is broken, or the servos have not confirmed torque off.",
            Reason.LATE: "The servos did not answer in this tick.",
        },
    ),
    "disarm": CommandKind(
        _ALL_MODES - {Mode.FAULT},
        "Switches torque off. A held object falls.",
        reply=("torque_off",),
    ),
    "tare": CommandKind(
        frozenset({Mode.DISARMED, Mode.ARMED}),
        "Sets the zero of the sensors to the mean of their next frames. The tips must be free.",
        refusals={
            Reason.SCENE: "The scene has no tactile sensors.",
            Reason.STATE: "Something touches a tip.",
        },
    ),
    "move": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}),
        "Moves one or both joints.",
        {"left": _JOINT, "right": _JOINT},
        refusals={
            Reason.REQUEST: "Neither joint is given.",
            Reason.BOUNDS: "An angle is outside its range.",
            Reason.SCENE: "The scene lacks this finger.",
        },
    ),
    "grasp": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        "Closes the fingers until both tips touch, then presses with the force. A hand that grips "
        "changes its force.",
        {"force": _FORCE},
        ("warning",),
        {
            Reason.BOUNDS: "The force is outside its range.",
            Reason.SCENE: "The scene lacks tactile sensors, or `servos.mode` is `position`.",
            Reason.STATE: "A limit is broken, or a tare is in progress.",
        },
    ),
    "rotate": CommandKind(
        GRIPPING_MODES,
        "Turns the grasped object at `control.rotate_speed`. A hand that is still grasping turns "
        "it as soon as it holds.",
        {"angle": Parameter(True, "rad", "range of the grip", "angle in the hand's frame")},
        _QUEUED,
        {
            Reason.BOUNDS: "The angle is outside the range of this grip, which the error names.",
            Reason.SCENE: "The scene lacks a finger or the object model.",
            Reason.STATE: "The object's angle is not known.",
        },
    ),
    "hold": CommandKind(
        frozenset({Mode.ARMED, Mode.MOVING}) | GRIPPING_MODES,
        "Follows setpoints that a program streams at 50 to 100 Hz. The first one grasps; a hand "
        "that grips keeps its mode.",
        {
            "force": _FORCE._replace(
                meaning="normal force of each tip; without it, a hand that grips keeps its force"
            ),
            "angle": Parameter(
                False, "rad", "limited to the range of the grip", "angle in the hand's frame"
            ),
        },
        ("angle", *_QUEUED, "warning"),
        _GRIP_REFUSALS | {Reason.REQUEST: "Neither force nor angle is given."},
    ),
    "release": CommandKind(_TORQUE_MODES, "Opens the fingers to `hand.open_angle`."),
    "set": CommandKind(
        _TORQUE_MODES,
        "Sets a property of the grip until the daemon ends.",
        {
            "compliance": Parameter(
                True,
                "rad/(N·m)",
                "",
                "rotation per torque on the object, 1 / `control.joint_stiffness`",
            )
        },
        refusals={Reason.BOUNDS: "The compliance is outside its range."},
    ),
    "demo": CommandKind(
        frozenset({Mode.DISARMED}),
        "Arms the hand and starts the task of the profile again (`task.name`).",
        refusals={Reason.SCENE: "The profile names no task."},
    ),
    "stop": CommandKind(
        _ALL_MODES,
        "Switches torque off at once. All commands that arrived before it are refused as "
        "`stopped`. It is never refused, and accepted with any further fields.",
        reply=("torque_off",),
    ),
    "clear": CommandKind(
        frozenset({Mode.FAULT}),
        "Ends a fault whose cause is gone, and reconnects servos and sensors. The hand is then "
        "disarmed.",
        refusals={
            Reason.STATE: "The cause persists, or servos or a sensor cannot be reached.",
        },
    ),
    "status": CommandKind(
        _ALL_MODES,
        "Returns the state of the daemon.",
        reply=("fault", "fault_name", "torque", "seq", "overruns", "counters", "limited"),
    ),
}

# These commands never stiffen or move the hand, so they are accepted even if they arrive late.
SAFE_COMMANDS = frozenset({"disarm", "tare", "clear"})
