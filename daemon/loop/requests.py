"""Validate requests to a running hand and execute them.

`gateway.commands` has already limited the size and rate of the requests. `wire.command_server` has
unpacked the requests. `control.modes` lists the commands allowed in each mode, and
`control.state_machine` defines the resulting motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from softfinger.daemon.control.envelope import Envelope
from softfinger.daemon.control.fingers import range_text
from softfinger.daemon.control.modes import (
    COMMANDS,
    GRIPPING_MODES,
    HOLDING_MODES,
    SAFE_COMMANDS,
    Mode,
)
from softfinger.daemon.control.state_machine import Control
from softfinger.daemon.errors import Reason, Refused, ServoError, TactileError
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.safety import Safety
from softfinger.daemon.safety.torque_state import TorqueState
from softfinger.daemon.types import FINGERS, GRIP_FRACTION, NO_LEASE_COMMANDS, EventSink, State

AGE_MAX = 1.0  # maximum age of all commands except status and stop [s]
# Maximum age of commands that switch torque on or move the hand [s]. A higher limit applies to
# ``hold`` during a grip.
_START_AGE_MAX = 0.2
_COMPLIANCE_RANGE = (0.01, 1.0)  # rad/(N·m)
_ENVELOPE_KEYS = frozenset({"command", "client"})
_MODE_REMEDIES = {Mode.DISARMED: "arm first", Mode.FAULT: "clear the fault first"}


class Command(NamedTuple):
    """Well-formed request that is allowed in the current mode."""

    name: str
    numbers: dict[str, float]
    client: str


def parse(request: dict[str, Any], mode: Mode) -> Command:
    """Validate a request against the command table. Raises Refused if the request is invalid."""
    name = request["command"]
    if name not in COMMANDS:
        raise _malformed(f"unknown command {name[:40]!r}; expected one of {', '.join(COMMANDS)}")
    client = request.get("client", "")
    if not isinstance(client, str) or len(client) > 64:
        raise _malformed("client: expected a string of up to 64 characters")
    heard, parameters = COMMANDS[name].modes, COMMANDS[name].parameters
    unknown = sorted(set(request) - _ENVELOPE_KEYS - set(parameters))
    if unknown:
        known = ", ".join(parameters) or "no parameters"
        raise _malformed(f"{name}: unknown parameter {unknown[0][:40]!r}; expected {known}")
    numbers = {}
    for key, parameter in parameters.items():
        if key not in request:
            if parameter.required:
                raise _malformed(f"{name}: {key} is missing")
            continue
        value = request[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _malformed(f"{name}: {key}: expected a number, found {type(value).__name__}")
        if not math.isfinite(value):
            raise _malformed(f"{name}: {key}: expected a finite number, found {value}")
        numbers[key] = float(value)
    if mode not in heard:
        hint = _MODE_REMEDIES.get(mode) or f"accepted in {', '.join(sorted(heard))}"
        if name == "clear":
            hint = "there is no fault"
        raise Refused(f"{name}: not accepted in mode {mode.value}; {hint}", Reason.MODE)
    return Command(name, numbers, client)


def _malformed(text: str) -> Refused:
    return Refused(text, Reason.REQUEST)


def bounds(settings: Settings, parameter: str) -> tuple[float, float]:
    """Return the range of a command parameter.

    The range is unbounded if it depends on the grip. For a force, the lower bound is excluded.
    """
    if parameter in FINGERS:
        hand, index = settings.hand, FINGERS.index(parameter)
        return hand.q_min[index], hand.q_max[index]
    if parameter == "force":
        return settings.control.contact_force, GRIP_FRACTION * settings.safety.force_max
    return _COMPLIANCE_RANGE if parameter == "compliance" else (-math.inf, math.inf)


def _out_of_range(key: str, value: float, low: float, high: float) -> str:
    if key in FINGERS:
        return range_text(value, low, high)
    if key == "force":
        return f"found {value:g} N, expected more than {low:g} N and at most {high:g} N"
    return f"found {value:g} rad/(N·m), expected {low:g} to {high:g}"


def command_age_max(settings: Settings, waits: bool) -> float:
    """Return the maximum age [s] of a command that switches torque on or moves the hand.

    An older command may have been sent before the servo watchdog stopped the hand. If ``waits`` is
    True, the servos' clock and watchdog pause while this machine is late.
    """
    watchdog = 0.0 if settings.simulated or waits else settings.servos.watchdog
    return min(_START_AGE_MAX, watchdog or _START_AGE_MAX)


class Lease:
    """Exclusive control of the hand by one client.

    The lease expires after a period without commands from the client. All unnamed clients share one
    lease. Commands that can only make the hand safer require no lease. Commands of a task require
    no lease and end any lease, so every client can take over from a task.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._owner = ""
        self._until = -math.inf

    def check(self, command: Command, now: float) -> None:
        """Raise Refused if another client holds the lease."""
        if command.name in NO_LEASE_COMMANDS:
            return
        if now < self._until and command.client != self._owner:
            owner = self._owner or "an unnamed client"
            text = f"{command.name}: {owner} holds the lease for another {self._until - now:.1f} s"
            raise Refused(text, Reason.LEASE)

    def lapses(self, now: float) -> str:
        """Return the name of the client whose lease has just expired, or an empty string.

        Each expiry is reported once.
        """
        if not -math.inf < self._until <= now:
            return ""
        self._until = -math.inf
        return self._owner or "the client in control"

    def renew(self, command: Command, now: float, by_task: bool = False) -> None:
        """Grant, extend or end the lease after a command has been executed."""
        if command.name not in NO_LEASE_COMMANDS:
            self._owner = command.client
            self._until = -math.inf if by_task else now + self.seconds


class Requests:
    """Request executor. Only the loop thread may use this class, between two stages of a tick."""

    def __init__(
        self,
        settings: Settings,
        state: State,
        control: Control,
        safety: Safety,
        torque: TorqueState,
        perception: Perception,
        emit: EventSink,
        waits: bool,
    ) -> None:
        """Create the executor; see `command_age_max` for ``waits``."""
        self._command_age_max = command_age_max(settings, waits)
        self._settings = settings
        self._state = state
        self._control = control
        self._safety = safety
        self._torque = torque
        self._perception = perception
        self._emit = emit
        self._handlers: dict[str, Callable[..., float | None]] = {
            "arm": control.arm,
            "disarm": control.disarm,
            "tare": perception.tare,
            "move": control.move,
            "grasp": control.grasp,
            "rotate": control.rotate,
            "hold": control.hold,
            "release": control.release,
            "set": control.set,
            "clear": control.disarm,
            "demo": lambda: None,  # The loop itself starts the task.
            "status": lambda: None,
        }
        self._lease = Lease(settings.commands.lease)
        self._envelope = Envelope(settings)

    def carry_out(
        self, request: dict[str, Any], age: float = 0.0, by_task: bool = False
    ) -> dict[str, Any]:
        """Execute a request, a command with its parameters, on the current tick.

        ``age`` is the time since the request arrived [s]. ``by_task`` is True if the request comes
        from a task. Returns the reply.

        Raises Refused if the request is rejected. The message gives the reason.
        """
        state, control = self._state, self._control
        # Accept a stop command in every mode, from every client and with unknown fields.
        if request["command"] == "stop":
            control.stop()
            return {"mode": control.mode.value, "torque_off": self._torque.off()}
        command = name, numbers, _ = parse(request, control.mode)
        grasps = name == "grasp" or (name == "hold" and control.mode not in GRIPPING_MODES)
        self._check_age(name, age)
        if not by_task:
            self._lease.check(command, state.t)
        if name == "clear":
            self._reconnect()
        if name in ("clear", "arm"):
            self._reopen(name)
        self._check(name, numbers, grasps)
        angle = self._handlers[name](**numbers)
        self._lease.renew(command, state.t, by_task)
        reply: dict[str, Any] = {"mode": control.mode.value}
        if angle is not None:
            reply["angle"] = angle
        if "angle" in numbers and control.mode is Mode.GRASPING:
            reply |= {"queued": name, "until": Mode.HOLDING.value}
        if grasps and (warning := self._envelope.warning(numbers["force"])):
            reply["warning"] = warning
            self._emit("warning", "grasp", warning)
        if name == "disarm":
            reply["torque_off"] = self._torque.off()
        elif name == "status":
            reply |= self._status()
        return reply

    def watch_silence(self) -> None:
        """Apply ``commands.on_silence`` when the controlling client's lease expires."""
        action = self._settings.commands.on_silence
        if action == "hold" or not (silent := self._lease.lapses(self._state.t)):
            return
        if self.end_grip(action):
            text = f"{silent} has not sent a command for {self._lease.seconds:g} s: {action}"
            self._emit("warning", "silence", text)

    def end_grip(self, action: str) -> bool:
        """Perform ``stop`` or ``release``; return False if the action would have no effect."""
        control = self._control
        if action == "stop" and control.torque:
            control.stop()
            self._torque.off()
        elif action == "release" and control.mode in GRIPPING_MODES | {Mode.MOVING}:
            control.release()
        else:
            return False
        return True

    def _check_age(self, name: str, age: float) -> None:
        """Raise Refused if a command is too old.

        After a stall, the client may no longer want the hand to move. The age limit is higher for
        setpoints during a grip and for harmless commands.
        """
        streamed = name == "hold" and self._control.mode in GRIPPING_MODES
        longest = AGE_MAX if streamed or name in SAFE_COMMANDS else self._command_age_max
        if age > longest:
            text = (
                f"{name}: the command was {age:.2f} s old when it was processed, expected at most "
                f"{longest:g} s"
            )
            raise Refused(f"{text}; send it again", Reason.LATE)

    def _check(self, name: str, numbers: dict[str, float], grasps: bool) -> None:
        """Raise Refused if the state, the scene or a limit rules out an otherwise valid command."""

        def refuse_if(condition: object, reason: Reason, text: str) -> None:
            if condition:
                raise Refused(f"{name}: {text}", reason)

        state, settings, fingers = self._state, self._settings, self._perception.fingers
        if name in ("arm", "clear"):
            refuse_if(
                state.torque and not self._control.torque,
                Reason.STATE,
                "the servos have not yet confirmed that torque is off: check the power supply "
                "and the cable",
            )
        if grasps or name in ("arm", "clear"):
            cause = self._safety.cause(state, gripping=name != "arm")
            refuse_if(cause, Reason.STATE, cause)
        if name == "arm":
            refuse_if(self._torque.servos is None, Reason.SCENE, "this scene has no servos")
            text = "the servos did not reply within this tick; send the command again"
            refuse_if(not state.reading.valid, Reason.LATE, text)
        elif name == "tare":
            refuse_if(not fingers, Reason.SCENE, "this scene has no tactile sensors")
            touched = any(contact.contact for contact in state.contacts)
            refuse_if(touched, Reason.STATE, "a tip is in contact; remove the load from both tips")
        elif name == "demo":
            text = (
                "the profile does not define a task; run one that does, for example "
                "`softfinger run --config demo`"
            )
            refuse_if(settings.task.name == "none", Reason.SCENE, text)
        elif name in ("move", "hold"):
            one, other = COMMANDS[name].parameters
            text = f"found neither {one} nor {other}, expected at least one"
            refuse_if(not numbers, Reason.REQUEST, text)
        if grasps:
            taring = any(perception.is_taring for perception in fingers)
            refuse_if(taring, Reason.STATE, "a tare is in progress")
            text = "this command requires a tactile sensor on each finger of the scene"
            refuse_if(not fingers, Reason.SCENE, text)
            text = 'servos.mode = "position" does not limit the current; select another mode'
            refuse_if(settings.servos.mode == "position", Reason.SCENE, text)
            numbers.setdefault("force", settings.control.force_default)
        for key, value in numbers.items():
            missing = key in FINGERS and key not in settings.scene.fingers
            refuse_if(missing, Reason.SCENE, f"this scene has no {key} finger")
            low, high = bounds(settings, key)
            is_inside = low <= value <= high and not (key == "force" and value == low)
            refuse_if(
                not is_inside, Reason.BOUNDS, f"{key}: {_out_of_range(key, value, low, high)}"
            )
        if "angle" in numbers:
            turns = len(settings.scene.fingers) == 2 and settings.scene.object_model
            text = "an angle requires two fingers and scene.object_model = true"
            refuse_if(not turns, Reason.SCENE, text)
            if self._control.mode in HOLDING_MODES and (name == "rotate" or not state.object.valid):
                text = self._control.fingers.turn_refusal(numbers["angle"])
                refuse_if(text, Reason.BOUNDS if state.object.valid else Reason.STATE, text)

    def _reconnect(self) -> None:
        """Reconnect servos that have stopped responding. Only ``clear`` calls this method.

        Raises Refused if the servos cannot be connected. The message lists all problems found.
        """
        state = self._state
        silent = state.t - state.reading.t > self._settings.servos.fault_after
        if self._torque.servos is None or not silent:
            return
        if self._torque.pending and not state.read_error:
            # The port works, so do not reconnect. Sending packets would end the bus silence that
            # trips the servo watchdogs.
            return
        try:
            self._torque.reconnect()
        except ServoError as error:
            raise Refused(f"clear: {error}") from None
        self._emit("info", "servos", "reconnected")

    def _reopen(self, name: str) -> None:
        """Reopen the sensors whose port was lost.

        Only ``clear`` and ``arm`` reopen sensors, and only while torque is off.

        Raises Refused if ``clear`` cannot reopen a sensor. A hand may be armed without sensors.
        """
        if self._state.torque:
            return
        for perception in self._perception.fingers:
            sensor, side = perception.sensor, FINGERS[perception.finger]
            if not sensor.counters().get("port_lost"):
                continue
            sensor.close()
            try:
                sensor.open()
            except TactileError as error:
                if name == "clear":
                    raise Refused(f"{name}: {error}") from None
                self._emit("warning", "tactile", str(error))
            else:
                self._emit("info", "tactile", f"the {side} sensor was reopened")
                self._perception.update(self._state)

    def _status(self) -> dict[str, Any]:
        state, servos = self._state, self._torque.servos
        counters = {} if servos is None else {"servos": servos.counters()}
        for perception in self._perception.fingers:
            counters[f"tactile-{FINGERS[perception.finger]}"] = perception.sensor.counters()
        return {
            "fault": state.fault,
            "fault_name": state.fault_name,
            "torque": state.torque,
            "seq": state.seq,
            "overruns": state.timing.overruns,
            "counters": counters,
            "limited": dict(self._safety.limited),
        }
