"""Emulate a Dynamixel X servo that drives a joint of the plant.

The model covers torque, operating modes, limits, profiles, the bus watchdog, hardware errors,
shutdown and reboot. :mod:`simulation.servo_model.servo_bus` handles the packets. PWM mode, which no
known client uses, is rejected as out of range. The emulator ignores the integral gain, the option
to restore RAM from a backup at startup, and the drive mode bit that switches torque on when a goal
is written.

The manuals do not specify how a servo handles partly invalid writes and torque-on requests after a
shutdown. In this emulation, a write that violates any rule leaves all registers unchanged. After a
shutdown, the servo returns RESULT_FAIL if a client tries to switch torque on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import JointPlant
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.servos.joint import JointScale
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.registers import ControlTable
from softfinger.daemon.simulation.servo_model.servo_joint import (
    POSITION_MODES,
    STEP_TIME,
    ServoHeat,
    ServoJoint,
)

OVERLOAD_TIME = 2.0  # time at the current limit after which an overload error occurs [s]
SENSE_INTERVAL = 0.010  # interval between checks of heat, voltage and overload [s]
REBOOT_TIME = 0.34  # duration of a reboot, during which the servo does not reply [s]
JUMP_COUNTS = 130  # jump of the encoder zero [counts], equal to 0.2 rad at the shaft
FAR_GOAL = 0.05  # distance from the joint angle above which a goal counts as far [rad]
_WATCHED_REGISTERS = frozenset((reg.GOAL_CURRENT, reg.GOAL_POSITION))
_VOLTAGE = 0  # bit number in the hardware error status
_CLEAR_FIRMWARE = 42
_CLEAR_KEY = b"\x01DXL\x22"


def prepared(model: ServoModel, mode: int) -> dict[int, int]:
    """Return the EEPROM values (return delay, operating mode) that the daemon requires."""
    needed = {reg.RETURN_DELAY_TIME: 0}
    return needed | {reg.OPERATING_MODE: mode} if mode in model.modes else needed


class EmulatedServo:
    """Emulated servo that drives joint number ``joint`` of ``plant``.

    All registers have factory defaults except for the ``eeprom`` values. ``heat`` and the no-load
    voltage ``supply`` [V] may be changed externally. A ``silent`` servo ignores all packets and
    sends no replies. In a ``frozen`` servo, the measured values and the clock stay constant. If
    ``refuses`` is set, the servo replies to every read with an error.
    """

    def __init__(
        self,
        model: ServoModel,
        plant: JointPlant,
        joint: int,
        scale: JointScale,
        eeprom: Mapping[int, int],
        *,
        firmware: int | None = None,
        heat: ServoHeat | None = None,
        t: float = 0.0,
    ) -> None:
        self.model = model
        self.firmware = model.firmware if firmware is None else firmware
        self.fast_reads = model.fast_read(self.firmware)
        self.table = ControlTable(model, self.firmware)
        self._memory = self.table.memory
        self.silent = self.frozen = self.refuses = False
        self.heat = ServoHeat(model) if heat is None else heat
        self.supply = model.supply
        self._drawn = 0.0  # motor current at the last check [A]
        self._overload = 0.0  # time at the current limit [s]
        self._joint = ServoJoint(model, self.table, plant, joint, scale)
        self.recorder = BusRecorder(t)
        self._watched = 0.0  # time when the watchdog was last restarted
        self._booted = t
        self._boot_at = -math.inf  # end of a reboot
        self._next_step = math.inf
        self._next_sense = t
        # Registered write that is waiting for an action instruction.
        self._registered: tuple[int, bytes] | None = None
        for address, value in eeprom.items():
            self.table.set(address, value)
        self._start(t)

    # --- state for the bus -----------------------------------------------------------------

    @property
    def id(self) -> int:
        return self._memory[reg.ID]

    @property
    def shadow(self) -> int:
        """Secondary ID, or −1; the servo executes instructions to this ID without replying.

        The register values 253 to 255 disable the secondary ID.
        """
        value = self._memory[reg.SHADOW_ID]
        return value if value <= framing.ID_MAX else -1

    @property
    def old_protocol(self) -> bool:
        """True if the servo is set to Protocol 1.0, of which this emulator supports only ping."""
        return self._memory[reg.PROTOCOL_TYPE] == 1

    @property
    def baud(self) -> int:
        return reg.BAUD_RATES[self._memory[reg.BAUD_RATE]]

    @property
    def return_delay(self) -> float:
        """Delay between an instruction and its reply [s]."""
        return self._memory[reg.RETURN_DELAY_TIME] * reg.RETURN_DELAY_UNIT

    def answers_reads(self, servo_id: int, fast: bool) -> bool:
        """Return True if this servo replies to a group read of ``servo_id``."""
        memory = self._memory
        if memory[reg.ID] != servo_id or not memory[reg.STATUS_RETURN_LEVEL]:
            return False
        return self.fast_reads or not fast

    @property
    def alert(self) -> int:
        """Alert bit in status packets."""
        return framing.ALERT if self._memory[reg.HARDWARE_ERROR_STATUS] else 0

    @property
    def torque_on(self) -> bool:
        """True while the motor torque is on."""
        return bool(self._memory[reg.TORQUE_ENABLE])

    @property
    def watchdog(self) -> float:
        """Bus watchdog timeout [s]; 0 while the watchdog is off or has stopped the motor."""
        ticks = self._memory[reg.BUS_WATCHDOG]
        return ticks * reg.WATCHDOG_UNIT if ticks <= reg.WATCHDOG_MAX else 0.0

    @property
    def _armed(self) -> bool:
        return self.torque_on and self.watchdog > 0.0

    @property
    def mode(self) -> int:
        return self._memory[reg.OPERATING_MODE]

    def awake(self, t: float) -> bool:
        """Return True if the servo is neither silent nor rebooting at time t."""
        return not self.silent and t >= self._boot_at

    # --- time ------------------------------------------------------------------------------

    def heard(self, t: float) -> None:
        """Restart the bus watchdog because an instruction packet has arrived on the bus."""
        self._watched = t
        self.recorder.heard(t, self.torque_on)

    def next_event(self) -> float:
        """Return the time [s] at which :meth:`act` must be called next."""
        if self._boot_at > -math.inf:
            return self._boot_at
        due = min(self._next_step, self._next_sense)
        return min(due, self._watched + self.watchdog) if self._armed else due

    def act(self, t: float) -> None:
        """Handle events due at time t; the plant must already have been advanced to t."""
        if t < self._boot_at:
            return
        if self._boot_at > -math.inf:
            self._boot_at = -math.inf
            self._start(t)
        if self._armed and t >= self._watched + self.watchdog:
            self.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR)
            self.recorder.fired(t)
            self._stop()
        if t >= self._next_step:
            if self.torque_on and self._joint.moves_by_itself():
                self._next_step = t + STEP_TIME
                self._joint.follow()
            else:
                self._next_step = math.inf
        if t >= self._next_sense:
            self._next_sense = t + SENSE_INTERVAL
            self._sense()

    # --- instructions ----------------------------------------------------------------------

    def read(self, address: int, length: int, t: float) -> bytes | None:
        """Return the bytes of an address range, or None if the servo rejects the read."""
        table = self.table
        if self.refuses or not 0 < length <= table.size - address:
            return None
        if not self.frozen and table.reads(
            address, length, reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE
        ):
            self._refresh(t)
        return table.read(address, length)

    def write(self, address: int, data: bytes, t: float) -> int:
        """Write an address range; return the error number, which is 0 for success."""
        error, plan = self.table.plan(address, data)
        values = {item.address: value for item, value in plan}
        self.recorder.goals(values, self._joint, self.torque_on, error != framing.OK)
        if error:
            return error
        was_on = self.torque_on
        for item, value in plan:
            self.table.set(item.address, value)
        for item, value in plan:
            self._effect(item.address, value, t)
        if self.torque_on and self._joint.moves_by_itself():
            self._next_step = min(self._next_step, t + STEP_TIME)
        if self.torque_on and not was_on:
            goal = self.table.get(reg.GOAL_POSITION)
            self.recorder.torque_on(t, self._joint, self.mode, goal)
        self._joint.drive()
        return framing.OK

    def register(self, address: int, data: bytes) -> int:
        """Store a write until :meth:`action` is called; return the error number."""
        error, _ = self.table.plan(address, data)
        if not error:
            self._registered = address, data
            self.table.set(reg.REGISTERED_INSTRUCTION, 1)
        return error

    def action(self, t: float) -> int:
        """Execute the last registered write; return the error number."""
        if self._registered is None:
            return framing.INSTRUCTION_ERROR
        (address, data), self._registered = self._registered, None
        self.table.set(reg.REGISTERED_INSTRUCTION, 0)
        return self.write(address, data, t)

    def reboot(self, t: float) -> None:
        """Switch torque off and restart after REBOOT_TIME with the default RAM values."""
        self.table.set(reg.TORQUE_ENABLE, 0)
        self._joint.drive()
        self._boot_at = t + REBOOT_TIME

    def factory_reset(self, option: bytes, t: float) -> int:
        """Restore the factory defaults, then reboot.

        Option FF restores all registers. Option 01 keeps the ID, and option 02 keeps the ID and the
        baud rate.
        """
        if len(option) != 1:
            return framing.DATA_LENGTH
        keep = {0xFF: (), 1: (reg.ID,), 2: (reg.ID, reg.BAUD_RATE)}.get(option[0])
        if keep is None:
            return framing.DATA_RANGE
        self.table.reset(keep)
        self.reboot(t)
        return framing.OK

    def clear(self, parameters: bytes, t: float) -> int:
        """Reset the position to a single turn. The reset fails while the shaft is moving."""
        if self.firmware < _CLEAR_FIRMWARE:
            return framing.INSTRUCTION_ERROR
        if parameters != _CLEAR_KEY:
            return framing.DATA_RANGE
        self._refresh(t)
        if self._memory[reg.MOVING]:
            return framing.RESULT_FAIL
        shift = self._joint.forget_turns()
        self.table.set(reg.GOAL_POSITION, self.table.get(reg.GOAL_POSITION) - shift)
        self._joint.profile.hold(self._joint.profile.position - shift)
        self._joint.drive()
        return framing.OK

    def report(self, t: float) -> dict[str, Any]:
        """Return the servo state and the record of the goals received."""
        stopped = self._memory[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR
        return {
            "id": self.id,
            "torque": self.torque_on,
            "mode": self.mode,
            "hardware_error": self._memory[reg.HARDWARE_ERROR_STATUS],
            "watchdog": None if stopped else self.watchdog,
            "stopped_by_watchdog": stopped,
            "q": self._joint.goal_angle(self._joint.position()),
            **self.recorder.report(t, self._joint, self.torque_on),
        }

    def fault(self, kind: str, t: float) -> None:
        """Start one of SERVO_FAULTS. ``recover`` does not clear a latched hardware error."""
        match kind:
            case "silent" | "answer":
                self.silent = kind == "silent"
            case "reboot":
                self.reboot(t)
            case "overheat":
                self.heat.warm(self.table.get(reg.TEMPERATURE_LIMIT) + 5.0)
            case "overload":
                self._fail(reg.OVERLOAD)
            case "undervoltage":
                self.supply = (self.model.voltage_min - 10) * reg.VOLTAGE_UNIT
            case "stuck":
                self._joint.stuck = self._joint.encoder()
            case "jump":
                self._joint.shift += JUMP_COUNTS
            case "frozen":
                self.frozen = True
            case "refuse":
                self.refuses = True
            case "recover":
                self.heat.warm(self.heat.ambient)
                self.supply = self.model.supply
                self.frozen = self.refuses = False
                self._joint.stuck, self._joint.shift = None, 0

    # --- effects of a write -----------------------------------------------------------------

    def _effect(self, address: int, value: int, t: float) -> None:
        if address == reg.TORQUE_ENABLE:
            if self.mode == reg.POSITION_MODE and value:
                self._joint.forget_turns()
            self._joint.hold()
            self._watched = t
            if value:
                self._joint.aim()
        elif address == reg.OPERATING_MODE:
            self._reset_mode()
        elif address in (reg.GOAL_POSITION, reg.GOAL_VELOCITY) and self.torque_on:
            self._joint.aim()
        elif address == reg.BUS_WATCHDOG:
            self._watched = t

    def _reset_mode(self) -> None:
        table = self.table
        for item in table.at.values():
            if reg.VELOCITY_I_GAIN <= item.address <= reg.FEEDFORWARD_1ST_GAIN:
                table.set(item.address, item.default)
        table.set(reg.PROFILE_ACCELERATION, 0)
        table.set(reg.PROFILE_VELOCITY, 0)
        if self.mode == reg.POSITION_MODE:
            self._joint.forget_turns()
        self._reset_goals()

    def _reset_goals(self) -> None:
        table = self.table
        table.set(reg.GOAL_PWM, table.get(reg.PWM_LIMIT))
        table.set(reg.GOAL_VELOCITY, 0)
        if self.model.senses_current:
            table.set(reg.GOAL_CURRENT, table.get(reg.CURRENT_LIMIT))
        table.set(reg.GOAL_POSITION, self._joint.position())

    def _start(self, t: float) -> None:
        """Start up after power-up or reboot."""
        table = self.table
        table.reset(first=reg.RAM)
        self._overload = 0.0
        self._booted = self._watched = t
        self._joint.forget_turns()
        self._registered = None
        self._reset_goals()
        # The byte is 0 if the firmware lacks this register.
        if self._memory[reg.STARTUP_CONFIGURATION] & 1:
            table.set(reg.TORQUE_ENABLE, 1)
        self._joint.hold()
        self._next_step = math.inf
        self._next_sense = t + SENSE_INTERVAL
        self._joint.drive()

    # --- internal events -------------------------------------------------------------------

    def _stop(self) -> None:
        """Stop after a bus watchdog timeout, and hold the present position with torque on."""
        table = self.table
        if self.mode == reg.CURRENT_MODE:
            table.set(reg.GOAL_CURRENT, 0)
        table.set(reg.GOAL_VELOCITY, 0)
        table.set(reg.PROFILE_ACCELERATION, 0)
        table.set(reg.PROFILE_VELOCITY, 0)
        table.set(reg.GOAL_POSITION, self._joint.position())
        self._joint.hold()
        self._joint.drive()

    def _refresh(self, t: float) -> None:
        self._joint.refresh(t - self._booted, self._voltage, self.heat.sensed)

    @property
    def _voltage(self) -> float:
        """Supply voltage [V] at the present motor current."""
        return self.supply - reg.SAG * self._drawn

    def _sense(self) -> None:
        """Advance heat and overload by SENSE_INTERVAL, and set the resulting hardware errors.

        The manuals do not specify when an overload error occurs. In the emulation, an overload
        error occurs after OVERLOAD_TIME at the configured current limit.
        """
        table, self._drawn = self.table, self._joint.current
        at_limit = self.torque_on and self._drawn >= 0.99 * self._joint.current_limit
        self._overload = self._overload + SENSE_INTERVAL if at_limit else 0.0
        self.heat.step(self._drawn, SENSE_INTERVAL)
        if self.heat.sensed > table.get(reg.TEMPERATURE_LIMIT):
            self._fail(reg.OVERHEATING)
        low, high = table.get(reg.MIN_VOLTAGE_LIMIT), table.get(reg.MAX_VOLTAGE_LIMIT)
        if not low <= round(self._voltage / reg.VOLTAGE_UNIT) <= high:
            self._fail(_VOLTAGE)
        if self._overload >= OVERLOAD_TIME:
            self._fail(reg.OVERLOAD)

    def _fail(self, bit: int) -> None:
        """Set a hardware error and its alert bit.

        The servo shuts down if the shutdown mask includes the error.
        """
        status = self.table.get(reg.HARDWARE_ERROR_STATUS) | 1 << bit
        self.table.set(reg.HARDWARE_ERROR_STATUS, status)
        if self.table.shut_down and self.torque_on:
            self.table.set(reg.TORQUE_ENABLE, 0)
            self._joint.drive()


class BusRecorder:
    """Record of the goals that a servo has received, for tests of the daemon's limits.

    Goals are recorded in counts, including goals that the servo rejects.
    """

    def __init__(self, t: float) -> None:
        self._goals: dict[int, tuple[int, int]] = {}  # minimum and maximum goal of each register
        self._refused = 0
        # Fields of the report.
        self._torque_on: dict[str, Any] = {"count": 0, "t": None, "far": 0, "farthest": 0.0}
        self._watchdog_fired: dict[str, Any] = {"count": 0, "t": None}
        self._last = t  # time of the last packet
        self._quiet = 0.0  # longest silence while torque is on [s]

    def goals(self, values: dict[int, int], joint: ServoJoint, torque: bool, refused: bool) -> None:
        """Record the goals in a write. While torque is off, ignore goals near the present angle."""
        goals = _WATCHED_REGISTERS & values.keys()
        self._refused += refused and bool(goals)
        for address in goals:
            value = values[address]
            if address == reg.GOAL_POSITION and not torque and _away(joint, value) <= FAR_GOAL:
                continue
            least, greatest = self._goals.get(address, (value, value))
            self._goals[address] = min(least, value), max(greatest, value)

    def torque_on(self, t: float, joint: ServoJoint, mode: int, position: int) -> None:
        """Record that torque was switched on at time t with the goal ``position`` [counts]."""
        record = self._torque_on
        record["count"] += 1
        record["t"] = self._last = t
        if mode in POSITION_MODES:
            away = _away(joint, position)
            record["far"] += away > FAR_GOAL
            record["farthest"] = max(record["farthest"], away)

    def heard(self, t: float, torque: bool) -> None:
        """Record a valid packet at time t."""
        if torque and t - self._last > self._quiet:
            self._quiet = t - self._last
        self._last = t

    def fired(self, t: float) -> None:
        """Record that the bus watchdog has stopped the motor."""
        self._watchdog_fired = {"count": self._watchdog_fired["count"] + 1, "t": t}

    def report(self, t: float, joint: ServoJoint, torque: bool) -> dict[str, Any]:
        """Return the record at time t in JSON format, with SI units and joint coordinates."""
        angles = [joint.goal_angle(each) for each in self._goals.get(reg.GOAL_POSITION, ())]
        currents = [joint.goal_current(each) for each in self._goals.get(reg.GOAL_CURRENT, ())]
        quiet = t - self._last
        return {
            "goal_q": sorted(angles) or None,
            "goal_current": sorted(currents) or None,
            "goals_refused": self._refused,
            "torque_on": dict(self._torque_on),
            "quiet": quiet if torque else None,
            "longest_quiet": max(self._quiet, quiet) if torque else self._quiet,
            "watchdog_fired": self._watchdog_fired,
        }


def _away(joint: ServoJoint, position: int) -> float:
    """Return the distance [rad] between a goal and the present joint angle."""
    return abs(joint.goal_angle(position) - joint.goal_angle(joint.position()))
