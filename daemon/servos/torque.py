"""Torque on and off, each step verified, and the servos' own bus watchdog behind it.

Torque goes on from the present angle with no current; goal current and goal position are put side
by side through indirect addresses, which live in RAM and so are set each time. Outside the tick:
nothing hurries here.
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Mapping, Sequence

from daemon.servos import registers as reg
from daemon.servos.base import ServoError
from daemon.servos.checks import check_angle
from daemon.servos.groups import GroupWrite
from daemon.servos.joints import GOAL_SIZE, Joint
from daemon.servos.line import ServoLine
from daemon.servos.models import ServoModel
from daemon.settings import Hand, ServoSettings

_GOAL_BYTES = (
    reg.GOAL_CURRENT,
    reg.GOAL_CURRENT + 1,
    reg.GOAL_POSITION,
    reg.GOAL_POSITION + 1,
    reg.GOAL_POSITION + 2,
    reg.GOAL_POSITION + 3,
)
_ASK_EVERY = 0.5  # s


class Torque:
    """The torque of all joints on one line. ``goals`` takes goals while it is on, else None."""

    def __init__(
        self,
        line: ServoLine,
        model: ServoModel,
        servos: ServoSettings,
        hand: Hand,
        joints: Sequence[Joint],
        mode: int,
    ) -> None:
        self.goals: GroupWrite | None = None
        self._line = line
        self._model = model
        self._hand = hand
        self._joints = {joint.id: joint for joint in joints}
        self._mode = mode
        ticks = 0
        if servos.watchdog > 0.0:
            ticks = math.ceil(servos.watchdog / reg.WATCHDOG_UNIT - 1e-9)
            ticks = min(max(ticks, 1), reg.WATCHDOG_MAX)
        self._ticks = ticks
        self._ask_every = _ASK_EVERY if ticks else math.inf
        self._quiet_limit = 0.8 * ticks * reg.WATCHDOG_UNIT if ticks else math.inf
        self._was_quiet = False  # the bus watchdog may have stopped the servos
        self._next_ask = math.inf  # when they are asked, time.monotonic()
        self._last_sent = 0.0  # time.monotonic() of the last packet the servos must have heard

    # --- on and off --------------------------------------------------------------------------

    def on(self) -> None:
        """Torque on from the present angle, with no current yet.

        Raises:
            ServoError: it could not be done or not be verified; off then was tried.
        """
        self._refuse_hardware_errors()
        try:
            self._switch_on()
        except ServoError:
            with contextlib.suppress(ServoError):
                self._store_all(reg.TORQUE_ENABLE, b"\x00", "torque off")
            raise

    def off(self) -> None:
        """Torque off. Raises ServoError when that could not be verified."""
        self._store_all(reg.TORQUE_ENABLE, b"\x00", "torque off")
        self.goals = None
        self._store_all(reg.BUS_WATCHDOG, b"\x00", "watchdog off")

    def _switch_on(self) -> None:
        # Writing 0 ends a watchdog's stop, in which goals are read-only.
        self._store_all(reg.BUS_WATCHDOG, b"\x00", "watchdog cleared")
        goals = self._choose_goals()
        if self._mode != reg.POSITION_MODE:
            self._store_all(reg.GOAL_CURRENT, bytes(2), "goal current")
        positions = self._positions()
        strayed = [text for text in self.strayed(positions) if text]
        if strayed:
            raise ServoError("\n".join(strayed))
        if self._mode != reg.CURRENT_MODE:
            packed = {each: struct.pack("<i", counts) for each, counts in positions.items()}
            self._store(reg.GOAL_POSITION, packed, "goal position")
        self._store_all(reg.TORQUE_ENABLE, b"\x01", "torque on")
        if self._ticks:
            self._store_all(reg.BUS_WATCHDOG, bytes((self._ticks,)), "watchdog armed")
        self._last_sent = time.monotonic()
        self._next_ask = self._last_sent + self._ask_every
        self._was_quiet = False
        self.goals = goals

    def _choose_goals(self) -> GroupWrite:
        """The one sync write of a tick: goal current, goal position, or both side by side."""
        address = {
            reg.CURRENT_MODE: reg.GOAL_CURRENT,
            reg.POSITION_MODE: reg.GOAL_POSITION,
        }.get(self._mode)
        if address is None:
            address = self._map_goals()
        line, size = self._line, GOAL_SIZE[self._mode]
        return GroupWrite(line.port, line.handler, address, size, list(self._joints))

    def _map_goals(self) -> int:
        """Put goal current and goal position side by side in the indirect data; its address."""
        starts = set()
        for servo_id, joint in self._joints.items():
            firmware = self._line.read(servo_id, reg.FIRMWARE_VERSION, 1)
            if firmware is None:
                raise ServoError(f"{joint.name}: no answer")
            address, data, _ = self._model.indirect_blocks(firmware[0])[0]
            starts.add((address, data))
        if len(starts) > 1:
            raise ServoError(
                "servos: their firmwares place indirect data differently: bring both to the same "
                "version"
            )
        address, data = starts.pop()
        pointers = struct.pack(f"<{len(_GOAL_BYTES)}H", *_GOAL_BYTES)
        self._store_all(address, pointers, "indirect addresses")
        return data

    # --- what may stand against it -----------------------------------------------------------

    def strayed(self, positions: Mapping[int, int]) -> list[str]:
        """What is wrong with the joints' angles; torque there would swing them back at once.

        ``positions`` in counts, by ID; one text for each, empty where all is well.
        """
        hand = self._hand
        return [
            check_angle(
                joint.name,
                joint.scale.angle(positions[servo_id]),
                hand.q_min[joint.finger],
                hand.q_max[joint.finger],
            )
            for servo_id, joint in self._joints.items()
        ]

    def _positions(self) -> dict[int, int]:
        positions = {}
        for servo_id, joint in self._joints.items():
            raw = self._line.read(servo_id, reg.PRESENT_POSITION, 4)
            if raw is None:
                raise ServoError(f"{joint.name}: position not read")
            positions[servo_id] = int.from_bytes(raw, "little", signed=True)
        return positions

    def _refuse_hardware_errors(self) -> None:
        lines = []
        for servo_id, joint in self._joints.items():
            raw = self._line.read(servo_id, reg.HARDWARE_ERROR_STATUS, 1)
            if raw is None:
                lines.append(f"{joint.name}: no answer: check its cable and power")
            elif raw[0]:
                lines.append(
                    f"{joint.name}: hardware error: {reg.hardware_error_names(raw[0])}: remove the "
                    "cause, then `softfinger doctor --fix` reboots it"
                )
        if lines:
            raise ServoError("\n".join(lines))

    # --- bus watchdog ------------------------------------------------------------------------

    def heard(self, t: float) -> None:
        """A packet that the servos must have heard went out at ``t`` (time.monotonic())."""
        if t - self._last_sent > self._quiet_limit:
            self._was_quiet = True
        self._last_sent = t

    def ask_watchdog_if_quiet(self, t: float) -> None:
        """Where the line was quiet for long, make sure that no servo's watchdog has stopped it.

        It is asked now and then all the same: what was sent in time may have been held up below,
        and a servo may have lost its power for less time than silence is borne.

        Raises:
            ServoError: one has, or is no longer armed.
        """
        quiet = self._was_quiet or t - self._last_sent > self._quiet_limit
        if not quiet and t < self._next_ask:
            return
        self._next_ask = t + self._ask_every
        unknown = False
        for servo_id, joint in self._joints.items():
            raw = self._line.read(servo_id, reg.BUS_WATCHDOG, 1)
            if raw is None:
                unknown = True
            elif raw[0] == reg.WATCHDOG_ERROR:
                raise ServoError(
                    f"{joint.name}: its bus watchdog stopped it, since no packet came in time: "
                    "clear, then arm"
                )
            elif raw[0] != self._ticks:
                raise ServoError(
                    f"{joint.name}: its bus watchdog is off, as after a reboot: check its supply, "
                    "then clear and arm"
                )
        self._was_quiet = quiet and unknown
        self._last_sent = time.monotonic()

    # --- verified writes ---------------------------------------------------------------------

    def _store_all(self, address: int, data: bytes, what: str) -> None:
        self._store(address, dict.fromkeys(self._joints, data), what)

    def _store(self, address: int, values: Mapping[int, bytes], what: str) -> None:
        failed = self._line.store(address, values)
        if failed:
            names = ", ".join(self._joints[servo_id].name for servo_id in failed)
            raise ServoError(f"{names}: {what} could not be set or not be verified")
