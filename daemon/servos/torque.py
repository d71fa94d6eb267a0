"""Switch torque on in verified steps, switch torque off, and manage the bus watchdog.

Torque is switched on at the current angle with zero motor current. Indirect addresses map goal
current and goal position to adjacent registers. Indirect addresses are in RAM and are therefore set
whenever torque is switched on.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping, Sequence

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import REBOOT_FIX, check_angle
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.servos.joint import GOAL_SIZE, Joint, goal_in, pack_goal
from softfinger.daemon.servos.protocol import GroupWrite, ServoLine
from softfinger.daemon.servos.register_table import armed_registers

_GOAL_BYTES = (
    *range(reg.GOAL_CURRENT, reg.GOAL_CURRENT + 2),
    *range(reg.GOAL_POSITION, reg.GOAL_POSITION + 4),
)
_PACKET_COUNT = 2  # number of times each torque-off packet is sent; servos do not confirm it
# Time limit for switching torque on, as a multiple of the reply timeout. Switching torque on blocks
# the loop.
_ON_TIMEOUTS = 50
_MOTION_MAX = 8  # maximum motion of a limp joint before torque is on [counts], equal to 0.7°


def goal_address(mode: int, model: ServoModel, firmware: int) -> int:
    """Return the address to which goals are written. Two goals require an indirect data address."""
    if mode == reg.CURRENT_MODE:
        return reg.GOAL_CURRENT
    if mode == reg.POSITION_MODE:
        return reg.GOAL_POSITION
    return model.indirect_blocks(firmware)[0][1]


class Torque:
    """Torque control for all joints on one line.

    ``goals`` writes the goals while torque is on. While torque is off, ``goals`` is None.
    ``may_be_on`` becomes True before torque is switched on and stays True until the servos have
    confirmed torque off.
    """

    def __init__(
        self, line: ServoLine, model: ServoModel, settings: Settings, joints: Sequence[Joint]
    ) -> None:
        self.goals: GroupWrite | None = None
        self.may_be_on = False
        self._line = line
        self._model = model
        self._hand = settings.hand
        self._joints = {joint.id: joint for joint in joints}
        self._mode = reg.MODE_NUMBERS[settings.servos.mode]
        ticks = math.ceil(settings.servos.watchdog / reg.WATCHDOG_UNIT - 1e-9)
        self._ticks = min(ticks, reg.WATCHDOG_MAX)
        self._not_after = math.inf  # deadline for switching torque on [s, time.monotonic()]
        ids = list(self._joints)
        self._offs = [
            GroupWrite(line.port, reg.TORQUE_ENABLE, 1, each) for each in (ids, *([i] for i in ids))
        ]
        self._watchdog_off = GroupWrite(line.port, reg.BUS_WATCHDOG, 1, ids)

    # --- on and off ------------------------------------------------------------------------------

    def on(self) -> None:
        """Switch torque on at the current angle with zero motor current.

        Raises ServoError if torque could not be switched on or verified. Torque may be on.
        """
        self._not_after = time.monotonic() + _ON_TIMEOUTS * self._line.port.reply_timeout
        tables = self._read_ram()
        # After a watchdog stop, goals are read-only until 0 is written to the watchdog register.
        self._store_all(reg.BUS_WATCHDOG, b"\x00", "watchdog cleared")
        self._restore_ram(tables)
        goals = self._choose_goals()
        if self._mode != reg.POSITION_MODE:
            self._store_all(reg.GOAL_CURRENT, bytes(2), "goal current")
        self.may_be_on = True
        # Start the watchdog before torque is switched on, so that it also stops servos in an
        # unverified state.
        if self._ticks:
            self._store_all(reg.BUS_WATCHDOG, bytes((self._ticks,)), "watchdog armed")
        positions = self._aim_here()
        self._store_all(reg.TORQUE_ENABLE, b"\x01", "torque on")
        for servo_id, joint in self._joints.items():
            joint.sent.clear()
            joint.sent.append(pack_goal(self._mode, 0, positions[servo_id]))
        self.goals = goals

    def ask_off(self) -> None:
        """Request torque off with one packet for all servos and one packet for each servo.

        The servos do not reply to the packets, so the caller must read the registers.
        """
        self.goals = None
        for _ in range(_PACKET_COUNT):
            for group in self._offs:
                group.send([b"\x00"] * len(group.ids))

    def is_off(self) -> bool:
        """Read the servos one by one; return True if each servo confirms that torque is off."""
        return all(self._line.read(i, reg.TORQUE_ENABLE, 1) == b"\x00" for i in self._joints)

    def confirmed_off(self) -> None:
        """Disable the watchdogs after the servos have confirmed torque off."""
        if self.may_be_on:
            self._watchdog_off.send([b"\x00"] * len(self._joints))
        self.may_be_on = False

    def _aim_here(self) -> dict[int, int]:
        """Set the goals to the current positions until the joints are at rest; return the goals."""
        while True:
            positions = self._positions()
            strayed = [
                check_angle(joint, positions[i], self._hand) for i, joint in self._joints.items()
            ]
            if self._mode == reg.POSITION_MODE:  # The servo refuses goals outside its limits.
                for i, joint in self._joints.items():
                    low, high = joint.ends
                    if not low <= positions[i] <= high:
                        found = f"the position is {positions[i]} counts, expected {low} to {high}"
                        strayed.append(Finding("FAIL", joint.name, found, "turn the joint by hand"))
            if any(strayed):
                raise ServoError("\n".join(str(each) for each in strayed if each))
            if self._mode == reg.CURRENT_MODE:
                return positions
            packed = {each: struct.pack("<i", counts) for each, counts in positions.items()}
            self._store(reg.GOAL_POSITION, packed, "goal position")
            after = self._positions()
            if all(abs(after[i] - positions[i]) <= _MOTION_MAX for i in after):
                return positions

    def _choose_goals(self) -> GroupWrite:
        """Return the sync write that sends the goals of a tick (current, position or both)."""
        addresses = {
            goal_address(self._mode, self._model, joint.firmware) for joint in self._joints.values()
        }
        if len(addresses) > 1:
            raise ServoError(
                "servos: found firmware versions with different indirect data addresses: update "
                "both servos to the same version"
            )
        if self._mode == reg.CURRENT_BASED_POSITION_MODE:
            # Map goal current and goal position to adjacent indirect data.
            pointers = struct.pack(f"<{len(_GOAL_BYTES)}H", *_GOAL_BYTES)
            self._store_all(reg.INDIRECT_ADDRESS, pointers, "indirect addresses")
        size = GOAL_SIZE[self._mode]
        return GroupWrite(self._line.port, addresses.pop(), size, list(self._joints))

    def _restore_ram(self, tables: Mapping[int, bytes]) -> None:
        """Restore RAM registers that another program may have changed.

        A servo keeps gains, profiles and the PWM limit until a reboot or a power failure.
        """
        for servo_id, table in tables.items():
            for row in armed_registers(self._model):
                if row.wrong_in(table, reg.RAM) is not None:
                    what, data = row.register.name, row.register.packed(row.value)
                    self._store(row.register.address, {servo_id: data}, what)

    # --- preconditions ---------------------------------------------------------------------------

    def _positions(self) -> dict[int, int]:
        positions = {}
        for servo_id, joint in self._joints.items():
            raw = self._line.read(servo_id, reg.PRESENT_POSITION, 4)
            if raw is None:
                raise ServoError(f"{joint.name}: the position could not be read")
            positions[servo_id] = int.from_bytes(raw, "little", signed=True)
        return positions

    def _read_ram(self) -> dict[int, bytes]:
        """Return each servo's registers from `RAM` up to the goals; refuse hardware errors."""
        tables, found = {}, []
        for servo_id, joint in self._joints.items():
            table = self._line.read(servo_id, reg.RAM, reg.GOAL_POSITION - reg.RAM)
            if table is None:
                fix = "check the power supply and the cable"
                found.append(Finding("FAIL", joint.name, "no reply", fix))
            elif status := table[reg.HARDWARE_ERROR_STATUS - reg.RAM]:
                error = f"hardware error: {reg.hardware_error_names(status)}"
                found.append(Finding("FAIL", joint.name, error, REBOOT_FIX))
            else:
                tables[servo_id] = table
        if found:
            raise ServoError("\n".join(map(str, found)))
        return tables

    # --- checks while torque is on ---------------------------------------------------------------

    def holds_goal(self, joint: Joint, table: bytes, start: int) -> bool:
        """Return True if a servo's goal is recent, or if this object did not switch torque on.

        ``table`` contains the servo's registers from address ``start`` on.

        Raises ServoError if the bus watchdog has stopped the servo or is no longer armed.
        """
        if self.goals is None:
            return True
        watchdog = table[reg.BUS_WATCHDOG - start]
        if watchdog == reg.WATCHDOG_ERROR:
            raise ServoError(
                f"{joint.name}: the bus watchdog stopped the servo because no packet arrived "
                "within servos.watchdog: send `clear`, then `arm`"
            )
        if watchdog != self._ticks:
            raise ServoError(
                f"{joint.name}: the bus watchdog is off, possibly because the servo has rebooted: "
                "check the supply, then send `clear` and `arm`"
            )
        return goal_in(self._mode, table, start) in joint.sent

    # --- verified writes -------------------------------------------------------------------------

    def _store_all(self, address: int, data: bytes, what: str) -> None:
        self._store(address, dict.fromkeys(self._joints, data), what)

    def _store(self, address: int, values: Mapping[int, bytes], what: str) -> None:
        failed: Sequence[int] = list(values)
        if time.monotonic() < self._not_after:
            failed = self._line.store(address, values)
        if failed:
            names = ", ".join(self._joints[servo_id].name for servo_id in failed)
            raise ServoError(f"{names}: {what} could not be set or verified")
