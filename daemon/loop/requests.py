"""A person's requests to a running hand: what they need beyond the control law, and their answers.

Which command is heard in which mode stands in `control.modes`, what it makes the hand do in
`control.state_machine`. Here stands what the state speaks against, what is connected or opened anew
on command, who may command, and what `status` says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from softfinger.daemon.control.modes import Lease, parse
from softfinger.daemon.control.state_machine import Control
from softfinger.daemon.errors import Refused, ServoError, TactileError
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.safety import Safety
from softfinger.daemon.safety.torque_state import Drive
from softfinger.daemon.types import FINGERS, State


class Orders:
    """Carries out requests between two stages of a tick. One thread, the loop's, may call it."""

    def __init__(
        self,
        settings: Settings,
        state: State,
        control: Control,
        safety: Safety,
        drive: Drive,
        perceptions: list[FingerPerception],
        emit: Callable[[str, str, str], None],
        feel: Callable[[], None],
        paced: Callable[[], int],
    ) -> None:
        """``feel`` looks at the sensors; ``paced`` counts commands refused since too many came."""
        self._state = state
        self._control = control
        self._safety = safety
        self._drive = drive
        self._perceptions = perceptions
        self._emit = emit
        self._feel = feel
        self._paced = paced
        self._silent_after = settings.servos.fault_after
        self._lease = Lease(settings.commands.lease)

    def carry_out(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked at the present tick; the reply. Raises Refused with the reason."""
        state, control = self._state, self._control
        command = parse(request, control.mode)
        self._lease.check(command, state.t)
        if command.name == "clear":
            self._reconnect()
        if command.name in ("clear", "arm"):
            self._reopen(command.name)
        self._refuse_unsafe(command.name)
        reply = control.command(command)
        self._lease.renew(command, state.t)
        if command.name in ("stop", "disarm"):
            reply["torque_off"] = "confirmed" if self._drive.off() else "unconfirmed"
        if command.name == "tare":
            for perception in self._perceptions:
                perception.tare()
        if command.name == "clear":
            state.fault = state.fault_name = ""
        if command.name == "status":
            reply |= self._status()
        return reply

    def _reconnect(self) -> None:
        """Servos that have gone silent are connected anew: only on command.

        Raises Refused with all that is wrong with them.
        """
        state = self._state
        silent = state.t - state.reading.t > self._silent_after
        if self._drive.servos is None or not silent:
            return
        if self._drive.pending and not state.read_error:
            return  # the port is there: connecting would only disturb the silence on it
        try:
            self._drive.reconnect()
        except ServoError as error:
            raise Refused(f"clear: {error}") from None
        self._emit("info", "servos", "connected anew")

    def _reopen(self, name: str) -> None:
        """Sensors whose port was lost are opened anew: only on command and with torque off.

        Raises Refused for ``clear`` where one can't be; without sensors a hand may be armed.
        """
        if self._state.torque:
            return
        for perception in self._perceptions:
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
                self._emit("info", "tactile", f"{side} sensor opened anew")
                self._feel()

    def _refuse_unsafe(self, name: str) -> None:
        """What neither the mode nor the control law knows, and still speaks against a command."""
        state = self._state
        if name in ("arm", "clear"):
            if state.torque and not self._control.torque:
                raise Refused(
                    f"{name}: the servos have not confirmed torque off yet: check their cable and "
                    "their power"
                )
            cause = self._safety.cause(state, gripping=name == "clear")
            if cause:
                raise Refused(f"{name}: {cause}")
        if name == "arm" and self._drive.servos is not None and not state.reading.valid:
            raise Refused("arm: the servos were not read at this tick")
        if name == "grasp":
            cause = self._safety.cause(state, gripping=True)
            if cause:
                raise Refused(f"grasp: {cause}")
            if any(perception.taring for perception in self._perceptions):
                raise Refused("grasp: tare is still at work")
        if name == "tare" and any(contact.contact for contact in state.contacts):
            raise Refused("tare: something touches a tip")

    def _status(self) -> dict[str, Any]:
        state, servos = self._state, self._drive.servos
        counters = {} if servos is None else {"servos": servos.counters()}
        for perception in self._perceptions:
            counters[f"tactile-{FINGERS[perception.finger]}"] = perception.sensor.counters()
        limited = dict(self._safety.limited)
        if paced := self._paced():
            limited["commands.pace"] = paced
        return {
            "fault": state.fault,
            "fault_name": state.fault_name,
            "torque": state.torque,
            "seq": state.seq,
            "overruns": state.timing.overruns,
            "counters": counters,
            "limited": limited,
        }
