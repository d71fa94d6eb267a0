"""One emulated Dynamixel X servo: what its registers mean, over a joint of a plant.

Holds the behaviour behind the control table: torque, operating modes, limits, profiles, bus
watchdog, hardware errors and shutdown, reboot, backup. Packets are the bus's affair
(:mod:`daemon.simulation.servo_bus`). Choices of our own, where the manuals say nothing: a write
that breaks any rule changes nothing at all; torque on after a shutdown is refused with RESULT_FAIL;
overload is OVERLOAD_TIME of current at the configured limit.
"""

from __future__ import annotations

import math
import struct

from daemon.servos import registers as reg
from daemon.servos.models import ServoModel
from daemon.servos.units import JointScale
from daemon.simulation import protocol
from daemon.simulation.control_table import ControlTable, Item
from daemon.simulation.joint_plant import JointPlant
from daemon.simulation.profile import Profile

REBOOT_TIME = 0.34  # s without an answer
OVERLOAD_TIME = 2.0  # s at the current limit
STEP = 0.001  # s: trajectories, velocity and PWM modes
SENSE = 0.010  # s: temperature, voltage and overload
AMBIENT = 25.0  # °C
THERMAL_TIME = 120.0  # s
THERMAL_RISE = 90.0  # °C over ambient at stall current, in the long run
_CLEAR_FIRMWARE = 42
_BACKUP_FIRMWARE = {True: 46, False: 45}  # X330, the others
_CLEAR_KEY = b"\x01DXL\x22"
_BACKUP_KEY = b"CTRL"
_PRESENT = struct.Struct("<HBBhhiiiiHB")  # registers 120 … 146
_GOALS = (reg.GOAL_PWM, reg.GOAL_CURRENT, reg.GOAL_VELOCITY, reg.GOAL_POSITION)
_POSITION_MODES = (
    reg.POSITION_MODE,
    reg.EXTENDED_POSITION_MODE,
    reg.CURRENT_BASED_POSITION_MODE,
)


class EmulatedServo:
    """A servo on joint ``joint`` of ``plant``, factory-new unless ``prepared``.

    ``prepared`` brings it up as the backend wants it: current-based position mode where the model
    has it, and no return delay. ``voltage`` and ``temperature`` may be set from outside, and
    ``silent`` makes it deaf and dumb.
    """

    def __init__(
        self,
        model: ServoModel,
        servo_id: int,
        plant: JointPlant,
        joint: int,
        scale: JointScale,
        *,
        firmware: int | None = None,
        prepared: bool = False,
        baud_index: int = 1,
        t: float = 0.0,
    ) -> None:
        self.model = model
        self.firmware = model.firmware if firmware is None else firmware
        self.table = ControlTable(model, self.firmware)
        self.silent = False
        self.voltage = (model.voltage_min + model.voltage_max) / 2 * reg.VOLTAGE_UNIT
        self.temperature = AMBIENT
        self._plant = plant
        self._joint = joint
        self._scale = scale
        self._profile = Profile()
        self._turns = 0  # whole turns that the position has forgotten
        self._registered: tuple[int, bytes] | None = None
        self._backup: dict[int, int] | None = None
        self._watched = 0.0  # time of the last packet the watchdog knows of
        self._booted = t
        self._boot_at = -math.inf  # a reboot ends then
        self._next_step = math.inf
        self._next_sense = t
        self._overload = 0.0
        self.table.set(reg.ID, servo_id)
        self.table.set(reg.BAUD_RATE, baud_index)
        if prepared:
            self.table.set(reg.RETURN_DELAY_TIME, 0)
            if reg.CURRENT_BASED_POSITION_MODE in model.modes:
                self.table.set(reg.OPERATING_MODE, reg.CURRENT_BASED_POSITION_MODE)
        self._start(t)

    # --- state that the bus asks for -------------------------------------------------------

    @property
    def id(self) -> int:
        """The ID it answers to."""
        return self.table.memory[reg.ID]

    @property
    def shadow_id(self) -> int:
        """The second ID it obeys without answering; above 252 it has none."""
        return self.table.memory[reg.SHADOW_ID]

    @property
    def baud(self) -> int:
        """The rate it listens at."""
        return reg.BAUD_RATES[self.table.memory[reg.BAUD_RATE]]

    @property
    def return_delay(self) -> float:
        """Seconds between an instruction and its reply."""
        return self.table.memory[reg.RETURN_DELAY_TIME] * reg.RETURN_DELAY_UNIT

    @property
    def status_return_level(self) -> int:
        """0 answers pings only, 1 reads too, 2 everything."""
        return self.table.memory[reg.STATUS_RETURN_LEVEL]

    @property
    def alert(self) -> int:
        """The alert bit of its status packets."""
        return protocol.ALERT if self.table.memory[reg.HARDWARE_ERROR_STATUS] else 0

    @property
    def fast_reads(self) -> bool:
        """Whether it answers fast sync and fast bulk read."""
        return self.model.fast_read(self.firmware)

    @property
    def torque_on(self) -> bool:
        """Whether the motor is driven."""
        return bool(self.table.memory[reg.TORQUE_ENABLE])

    @property
    def mode(self) -> int:
        """The operating mode."""
        return self.table.memory[reg.OPERATING_MODE]

    def awake(self, t: float) -> bool:
        """Whether it hears and answers at time t: neither silent nor rebooting."""
        return not self.silent and t >= self._boot_at

    # --- time ------------------------------------------------------------------------------

    def heard(self, t: float) -> None:
        """An instruction packet went by: the bus watchdog starts anew."""
        self._watched = t

    def next_event(self) -> float:
        """When :meth:`act` next has something to do [s]."""
        due = min(self._next_step, self._next_sense)
        if self._boot_at > -math.inf:
            return min(due, self._boot_at)
        ticks = self.table.memory[reg.BUS_WATCHDOG]
        if 0 < ticks <= reg.WATCHDOG_MAX and self.torque_on:
            due = min(due, self._watched + ticks * reg.WATCHDOG_UNIT)
        return due

    def act(self, t: float) -> None:
        """Do what is due at time t; the plant must have been advanced to it."""
        if self._boot_at > -math.inf:
            if t < self._boot_at:
                self._next_sense = max(self._next_sense, self._boot_at)
                return
            self._boot_at = -math.inf
            self._start(t)
        ticks = self.table.memory[reg.BUS_WATCHDOG]
        armed = 0 < ticks <= reg.WATCHDOG_MAX and self.torque_on
        if armed and t >= self._watched + ticks * reg.WATCHDOG_UNIT:
            self.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR)
            self._stop()
        if t >= self._next_step:
            self._next_step = t + STEP
            self._follow()
        if t >= self._next_sense:
            self._next_sense = t + SENSE
            self._sense()

    # --- instructions ----------------------------------------------------------------------

    def read(self, address: int, length: int, t: float) -> bytes | None:
        """The bytes of a span, or None when it does not lie inside the table."""
        table = self.table
        if not table.holds(address, length):
            return None
        if table.reads(address, length, reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE):
            self._refresh(t)
        return table.read(address, length)

    def write(self, address: int, data: bytes, t: float) -> int:
        """Write a span; the error number, 0 when all of it was done."""
        error, plan = self._checked(address, data)
        if error:
            return error
        for item, value in plan:
            self.table.set(item.address, value)
        for item, value in plan:
            self._effect(item.address, value, t)
        self._drive()
        return protocol.OK

    def register(self, address: int, data: bytes) -> int:
        """Keep a write for :meth:`action`."""
        error, _ = self._checked(address, data)
        if error == protocol.OK:
            self._registered = (address, data)
            self.table.set(reg.REGISTERED_INSTRUCTION, 1)
        return error

    def action(self, t: float) -> int:
        """Do the write that was kept."""
        if self._registered is None:
            return protocol.INSTRUCTION_ERROR
        address, data = self._registered
        self._registered = None
        self.table.set(reg.REGISTERED_INSTRUCTION, 0)
        return self.write(address, data, t)

    def reboot(self, t: float) -> None:
        """Torque off, silence for REBOOT_TIME, then RAM as after power-up."""
        self.table.set(reg.TORQUE_ENABLE, 0)
        self._drive()
        self._next_step = math.inf
        self._boot_at = t + REBOOT_TIME
        self._next_sense = self._boot_at

    def factory_reset(self, option: int, t: float) -> int:
        """Factory defaults (0xFF all, 1 keeps the ID, 2 the baud rate too), then a reboot."""
        keep = {0xFF: (), 1: (reg.ID,), 2: (reg.ID, reg.BAUD_RATE)}.get(option)
        if keep is None:
            return protocol.DATA_RANGE
        self.table.set(reg.TORQUE_ENABLE, 0)
        self.table.reset(keep)
        self.reboot(t)
        return protocol.OK

    def clear(self, parameters: bytes, t: float) -> int:
        """Bring the position back into one turn; fails while the shaft moves."""
        if self.firmware < _CLEAR_FIRMWARE:
            return protocol.INSTRUCTION_ERROR
        if parameters != _CLEAR_KEY:
            return protocol.DATA_RANGE
        self._refresh(t)
        if self.table.memory[reg.MOVING]:
            return protocol.RESULT_FAIL
        before = self._turns
        self._forget_turns()
        shift = self._sign() * (self._turns - before) * reg.COUNTS_PER_TURN
        self.table.set(reg.GOAL_POSITION, self.table.get(reg.GOAL_POSITION) - shift)
        self._profile.hold(self._profile.position - shift)
        self._drive()
        return protocol.OK

    def backup(self, parameters: bytes, t: float) -> int:
        """Store the control table (1), or restore its EEPROM and reboot (2)."""
        if self.firmware < _BACKUP_FIRMWARE[self.model.small]:
            return protocol.INSTRUCTION_ERROR
        if len(parameters) != 5 or parameters[1:] != _BACKUP_KEY or parameters[0] not in (1, 2):
            return protocol.DATA_RANGE
        if self.torque_on:
            return protocol.RESULT_FAIL
        if parameters[0] == 1:
            self._backup = {
                item.address: self.table.get(item.address)
                for item in self.table.items
                if item.writable and (item.saved or item.backed_up)
            }
            self.table.set(reg.BACKUP_READY, 1)
            return protocol.OK
        if self._backup is None:
            return protocol.RESULT_FAIL
        self._restore(saved=True)
        self.reboot(t)
        return protocol.OK

    def fail(self, bit: int) -> None:
        """A hardware error: told by the alert bit, and a shutdown if the mask has its bit."""
        status = self.table.get(reg.HARDWARE_ERROR_STATUS) | 1 << bit
        self.table.set(reg.HARDWARE_ERROR_STATUS, status)
        if self._shut_down() and self.torque_on:
            self.table.set(reg.TORQUE_ENABLE, 0)
            self._drive()

    def recover(self) -> None:
        """Cool down and bring the supply back; a latched hardware error stays until a reboot."""
        self.temperature = AMBIENT
        self.voltage = (self.model.voltage_min + self.model.voltage_max) / 2 * reg.VOLTAGE_UNIT

    # --- rules of writing ------------------------------------------------------------------

    def _checked(self, address: int, data: bytes) -> tuple[int, list[tuple[Item, int]]]:
        error, plan = self.table.plan(address, data)
        if error:
            return error, []
        for item, value in plan:
            error = self._refusal(item, value)
            if error:
                return error, []
        return protocol.OK, plan

    def _refusal(self, item: Item, value: int) -> int:
        table, address = self.table, item.address
        if item.saved and self.torque_on:
            return protocol.ACCESS
        if address in _GOALS:
            if table.memory[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR:
                return protocol.DATA_RANGE
            return protocol.OK if self._within_limit(address, value) else protocol.DATA_LIMIT
        if address == reg.OPERATING_MODE and value not in self.model.modes:
            return protocol.DATA_RANGE
        if address == reg.BUS_WATCHDOG and value and table.memory[address] == reg.WATCHDOG_ERROR:
            return protocol.DATA_RANGE
        if address == reg.TORQUE_ENABLE and value and self._shut_down():
            return protocol.RESULT_FAIL
        pairs = {
            reg.MIN_POSITION_LIMIT: lambda: value <= table.get(reg.MAX_POSITION_LIMIT),
            reg.MAX_POSITION_LIMIT: lambda: value >= table.get(reg.MIN_POSITION_LIMIT),
            reg.MIN_VOLTAGE_LIMIT: lambda: value <= table.get(reg.MAX_VOLTAGE_LIMIT),
            reg.MAX_VOLTAGE_LIMIT: lambda: value >= table.get(reg.MIN_VOLTAGE_LIMIT),
        }
        holds = pairs.get(address)
        return protocol.DATA_LIMIT if holds is not None and not holds() else protocol.OK

    def _within_limit(self, address: int, value: int) -> bool:
        table = self.table
        if address == reg.GOAL_POSITION:
            if self.mode != reg.POSITION_MODE:
                return True
            low, high = table.get(reg.MIN_POSITION_LIMIT), table.get(reg.MAX_POSITION_LIMIT)
            return low <= value <= high
        limit = {
            reg.GOAL_PWM: reg.PWM_LIMIT,
            reg.GOAL_CURRENT: reg.CURRENT_LIMIT,
            reg.GOAL_VELOCITY: reg.VELOCITY_LIMIT,
        }[address]
        return abs(value) <= table.get(limit)

    def _shut_down(self) -> bool:
        memory = self.table.memory
        return bool(memory[reg.HARDWARE_ERROR_STATUS] & memory[reg.SHUTDOWN])

    def _effect(self, address: int, value: int, t: float) -> None:
        if address == reg.TORQUE_ENABLE:
            if self.mode == reg.POSITION_MODE and value:
                self._forget_turns()
            self._profile.hold(self._position())
            self._watched = t
            if value:
                self._aim()
        elif address == reg.OPERATING_MODE:
            self._reset_mode()
        elif address in (reg.GOAL_POSITION, reg.GOAL_VELOCITY) and self.torque_on:
            self._aim()
        elif address == reg.BUS_WATCHDOG:
            self._watched = t
        if self._stepping():
            self._next_step = min(self._next_step, t + STEP)

    def _reset_mode(self) -> None:
        table = self.table
        for item in table.items:
            if reg.VELOCITY_I_GAIN <= item.address <= reg.FEEDFORWARD_1ST_GAIN:
                table.set(item.address, item.default)
        table.set(reg.PROFILE_ACCELERATION, 0)
        table.set(reg.PROFILE_VELOCITY, 0)
        if self.mode == reg.POSITION_MODE:
            self._forget_turns()
        self._reset_goals()

    def _reset_goals(self) -> None:
        table = self.table
        table.set(reg.GOAL_PWM, table.get(reg.PWM_LIMIT))
        table.set(reg.GOAL_VELOCITY, 0)
        if self.model.senses_current:
            table.set(reg.GOAL_CURRENT, table.get(reg.CURRENT_LIMIT))
        table.set(reg.GOAL_POSITION, self._position())

    def _start(self, t: float) -> None:
        """Power-up, or the end of a reboot."""
        table = self.table
        startup = table.memory[reg.STARTUP_CONFIGURATION] if self._has_startup() else 0
        table.reset_ram()
        if startup & 2 and self._backup is not None:
            self._restore(saved=False)
        if self._backup is not None:
            table.set(reg.BACKUP_READY, 1)
        self._registered = None
        self._overload = 0.0
        self._booted = self._watched = t
        self._forget_turns()
        self._reset_goals()
        self._profile.hold(self._position())
        self._next_step = math.inf
        self._next_sense = t + SENSE
        if startup & 1:
            table.set(reg.TORQUE_ENABLE, 1)
        self._drive()

    def _has_startup(self) -> bool:
        return reg.STARTUP_CONFIGURATION in self.table.at

    def _restore(self, saved: bool) -> None:
        assert self._backup is not None
        for address, value in self._backup.items():
            if self.table.at[address].saved == saved:
                self.table.set(address, value)

    # --- the joint -------------------------------------------------------------------------

    def _sign(self) -> int:
        return -1 if self.table.memory[reg.DRIVE_MODE] & 1 else 1

    def _encoder(self) -> int:
        return self._scale.position_counts(float(self._plant.q[self._joint]))

    def _forget_turns(self) -> None:
        self._turns = self._encoder() // reg.COUNTS_PER_TURN

    def _position(self) -> int:
        within = self._encoder() - self._turns * reg.COUNTS_PER_TURN
        return self._sign() * within + self.table.get(reg.HOMING_OFFSET)

    def _joint_angle(self, position: float) -> float:
        within = self._sign() * (position - self.table.get(reg.HOMING_OFFSET))
        return self._scale.angle(within + self._turns * reg.COUNTS_PER_TURN)

    def _aim(self) -> None:
        """Start the trajectory to the goals as the profile registers ask."""
        table, profile = self.table, self._profile
        speed, acceleration = table.get(reg.PROFILE_VELOCITY), table.get(reg.PROFILE_ACCELERATION)
        per_velocity = reg.VELOCITY_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
        per_acceleration = reg.ACCELERATION_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
        if self.mode in _POSITION_MODES:
            target = float(table.get(reg.GOAL_POSITION))
            if table.memory[reg.DRIVE_MODE] & 4:
                profile.aim_in(target, speed / 1000.0, acceleration / 1000.0)
            else:
                profile.aim(target, speed * per_velocity, acceleration * per_acceleration)

    def _stepping(self) -> bool:
        if not self.torque_on:
            return False
        if self.mode in _POSITION_MODES:
            return self._profile.busy
        return self.mode in (reg.VELOCITY_MODE, reg.PWM_MODE)

    def _follow(self) -> None:
        """One STEP of whatever moves by itself."""
        if not self._stepping():
            self._next_step = math.inf
            return
        if self.mode in _POSITION_MODES:
            self._profile.step(STEP)
        elif self.mode == reg.VELOCITY_MODE:
            turn = reg.VELOCITY_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
            self._profile.velocity = self.table.get(reg.GOAL_VELOCITY) * turn
            self._profile.position += self._profile.velocity * STEP
        self._drive()

    def _stop(self) -> None:
        """The bus watchdog's stop: stand where the shaft is, with torque still on."""
        table = self.table
        if reg.GOAL_CURRENT in table.at and self.mode == reg.CURRENT_MODE:
            table.set(reg.GOAL_CURRENT, 0)
        if self.mode == reg.PWM_MODE:
            table.set(reg.GOAL_PWM, 0)
        table.set(reg.GOAL_VELOCITY, 0)
        table.set(reg.PROFILE_ACCELERATION, 0)
        table.set(reg.PROFILE_VELOCITY, 0)
        table.set(reg.GOAL_POSITION, self._position())
        self._profile.hold(self._position())
        self._drive()

    def _drive(self) -> None:
        """Tell the plant what the registers say."""
        mode, joint, table = self.mode, self._joint, self.table
        if not self.torque_on:
            self._plant.drive(joint, reg.CURRENT_MODE, False, 0.0, 0.0)
            return
        if mode in (reg.CURRENT_MODE, reg.PWM_MODE):
            if mode == reg.CURRENT_MODE:
                current = self._scale.amperes(self._sign() * table.get(reg.GOAL_CURRENT))
            else:
                current = self._pwm_current()
            self._plant.drive(joint, reg.CURRENT_MODE, True, 0.0, current)
            return
        goal = self._joint_angle(self._profile.position)
        if mode == reg.CURRENT_BASED_POSITION_MODE:
            bound = abs(table.get(reg.GOAL_CURRENT)) * self.model.current_unit
            self._plant.drive(joint, reg.CURRENT_BASED_POSITION_MODE, True, goal, bound)
            return
        bound = self.model.stall_current
        if self.model.senses_current:
            bound = table.get(reg.CURRENT_LIMIT) * self.model.current_unit
        self._plant.drive(joint, reg.POSITION_MODE, True, goal, bound)

    def _pwm_current(self) -> float:
        """Current [A] of the joint's motor under goal PWM: supply less back-EMF over resistance."""
        duty = self._sign() * self._scale.direction * self.table.get(reg.GOAL_PWM) / 885.0
        speed = float(self._plant.dq[self._joint]) * reg.VELOCITY_UNIT / self._scale.velocity
        return self.model.stall_current * (duty - speed / self.model.no_load_speed)

    # --- what it measures ------------------------------------------------------------------

    def _sense(self) -> None:
        table = self.table
        current = abs(float(self._plant.current[self._joint]))
        share = current / self.model.stall_current
        warm = AMBIENT + THERMAL_RISE * share * share
        self.temperature += (warm - self.temperature) * SENSE / THERMAL_TIME
        if self.temperature > table.get(reg.TEMPERATURE_LIMIT):
            self.fail(2)
        low, high = table.get(reg.MIN_VOLTAGE_LIMIT), table.get(reg.MAX_VOLTAGE_LIMIT)
        if not low <= round(self.voltage / reg.VOLTAGE_UNIT) <= high:
            self.fail(0)
        limit = self.model.stall_current
        if self.model.senses_current:
            limit = table.get(reg.CURRENT_LIMIT) * self.model.current_unit
        self._overload = self._overload + SENSE if self.torque_on and current >= limit else 0.0
        if self._overload >= OVERLOAD_TIME:
            self.fail(5)

    def _refresh(self, t: float) -> None:
        """Bring registers 120 … 146 up to date."""
        table, scale, joint, profile = self.table, self._scale, self._joint, self._profile
        sign = self._sign()
        speed = float(self._plant.dq[joint])
        ampere = float(self._plant.current[joint])
        velocity = sign * scale.velocity_counts(speed)
        position = self._position()
        share = ampere / self.model.stall_current
        turned = speed * reg.VELOCITY_UNIT / scale.velocity / self.model.no_load_speed
        pwm = 885.0 * sign * scale.direction * (share + turned) if self.torque_on else 0.0
        if self.model.senses_current:
            current = sign * scale.current_counts(ampere)
        else:  # the register is present load, 0.1 %
            current = round(sign * scale.direction * 1000.0 * ampere / self.model.stall_current)
        arrived = abs(profile.target - position) <= 20 and not profile.busy
        per_velocity = reg.VELOCITY_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
        _PRESENT.pack_into(
            table.memory,
            reg.REALTIME_TICK,
            int((t - self._booted) * 1000.0 + 1e-6) & 0x7FFF,
            abs(velocity) > table.get(reg.MOVING_THRESHOLD),
            int(arrived) | (2 if profile.busy else 0),
            max(-885, min(885, round(pwm))),
            max(-32768, min(32767, current)),
            velocity,
            position,
            round(profile.velocity / per_velocity),
            round(profile.position),
            max(0, round(self.voltage / reg.VOLTAGE_UNIT)),
            max(0, min(255, round(self.temperature))),
        )
