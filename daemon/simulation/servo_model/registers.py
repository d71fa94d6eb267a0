"""Define the registers of an emulated servo, and check writes to these registers.

:mod:`simulation.servo_model.servo` implements the effects of accepted writes.
"""

from __future__ import annotations

from typing import NamedTuple

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.simulation.servo_model import framing

_GAIN_MAX = 16_383
_PROFILE_MAX = 32_767
_OFFSET_MAX = 1_044_479
_MULTI_TURN = 1_048_575
_STARTUP_FIRMWARE = 45
_GOALS = (reg.GOAL_PWM, reg.GOAL_CURRENT, reg.GOAL_VELOCITY, reg.GOAL_POSITION)
_LIMITS = {
    reg.GOAL_PWM: reg.PWM_LIMIT,
    reg.GOAL_CURRENT: reg.CURRENT_LIMIT,
    reg.GOAL_VELOCITY: reg.VELOCITY_LIMIT,
}
_PAIRS = {  # maps lower limits to the corresponding upper limits
    reg.MIN_POSITION_LIMIT: reg.MAX_POSITION_LIMIT,
    reg.MIN_VOLTAGE_LIMIT: reg.MAX_VOLTAGE_LIMIT,
}
_UPPER = {upper: lower for lower, upper in _PAIRS.items()}


class Item(NamedTuple):
    """One register.

    ``low`` and ``high`` are the limits stated in the manual. The values of other registers may
    narrow this range. Clients cannot write a register whose ``high`` is below ``low``.
    """

    address: int
    size: int
    default: int = 0
    low: int = 0
    high: int = -1

    @property
    def writable(self) -> bool:
        return self.low <= self.high

    @property
    def signed(self) -> bool:
        return self.low < 0


def _items_of(model: ServoModel, firmware: int) -> list[Item]:
    """Return all registers for a model and firmware, sorted by address."""
    low, high = model.voltage_bound, model.voltage_max
    items = [
        Item(reg.MODEL_NUMBER, 2, model.number),
        Item(reg.MODEL_INFORMATION, 4),
        Item(reg.FIRMWARE_VERSION, 1, firmware),
        Item(reg.ID, 1, 1, 0, framing.ID_MAX),
        Item(reg.BAUD_RATE, 1, 1, 0, model.highest_baud),
        Item(reg.RETURN_DELAY_TIME, 1, 250, 0, 254),
        Item(reg.DRIVE_MODE, 1, 0, 0, model.drive_mode_max),
        Item(reg.OPERATING_MODE, 1, reg.POSITION_MODE, 0, reg.CURRENT_BASED_POSITION_MODE),
        Item(reg.SHADOW_ID, 1, 255, 0, 255),
        Item(reg.PROTOCOL_TYPE, 1, 2, 2 if model.is_x330 else 1, 2),
        Item(reg.HOMING_OFFSET, 4, 0, -_OFFSET_MAX, _OFFSET_MAX),
        Item(reg.MOVING_THRESHOLD, 4, 10, 0, 1023),
        Item(reg.TEMPERATURE_LIMIT, 1, model.temperature_limit, 0, 100),
        Item(reg.MAX_VOLTAGE_LIMIT, 2, high, low, high),
        Item(reg.MIN_VOLTAGE_LIMIT, 2, model.voltage_min, low, high),
        Item(reg.PWM_LIMIT, 2, 885, 0, 885),
        Item(reg.VELOCITY_LIMIT, 4, model.velocity_limit, 0, model.velocity_max),
        Item(reg.MAX_POSITION_LIMIT, 4, 4095, 0, 4095),
        Item(reg.MIN_POSITION_LIMIT, 4, 0, 0, 4095),
        Item(reg.SHUTDOWN, 1, model.shutdown, 0, 63),
        Item(reg.TORQUE_ENABLE, 1, 0, 0, 1),
        Item(reg.LED, 1, 0, 0, 1),
        Item(reg.STATUS_RETURN_LEVEL, 1, 2, 0, 2),
        Item(reg.REGISTERED_INSTRUCTION, 1),
        Item(reg.HARDWARE_ERROR_STATUS, 1),
        Item(reg.VELOCITY_I_GAIN, 2, model.velocity_gains[0], 0, _GAIN_MAX),
        Item(reg.VELOCITY_P_GAIN, 2, model.velocity_gains[1], 0, _GAIN_MAX),
        Item(reg.POSITION_D_GAIN, 2, model.position_gains[0], 0, _GAIN_MAX),
        Item(reg.POSITION_I_GAIN, 2, model.position_gains[1], 0, _GAIN_MAX),
        Item(reg.POSITION_P_GAIN, 2, model.position_gains[2], 0, _GAIN_MAX),
        Item(reg.FEEDFORWARD_2ND_GAIN, 2, 0, 0, _GAIN_MAX),
        Item(reg.FEEDFORWARD_1ST_GAIN, 2, 0, 0, _GAIN_MAX),
        Item(reg.BUS_WATCHDOG, 1, 0, 0, reg.WATCHDOG_MAX),
        Item(reg.GOAL_PWM, 2, 885, -885, 885),
        Item(reg.GOAL_VELOCITY, 4, 0, -model.velocity_max, model.velocity_max),
        Item(reg.PROFILE_ACCELERATION, 4, 0, 0, _PROFILE_MAX),
        Item(reg.PROFILE_VELOCITY, 4, 0, 0, _PROFILE_MAX),
        Item(reg.GOAL_POSITION, 4, 0, -_MULTI_TURN, _MULTI_TURN),
        Item(reg.REALTIME_TICK, 2),
        Item(reg.MOVING, 1),
        Item(reg.MOVING_STATUS, 1),
        Item(reg.PRESENT_PWM, 2),
        Item(reg.PRESENT_CURRENT, 2),
        Item(reg.PRESENT_VELOCITY, 4),
        Item(reg.PRESENT_POSITION, 4),
        Item(reg.VELOCITY_TRAJECTORY, 4),
        Item(reg.POSITION_TRAJECTORY, 4),
        Item(reg.PRESENT_INPUT_VOLTAGE, 2),
        Item(reg.PRESENT_TEMPERATURE, 1),
    ]
    if model.senses_current:
        limit = model.current_limit
        items.append(Item(reg.CURRENT_LIMIT, 2, limit, 0, limit))
        items.append(Item(reg.GOAL_CURRENT, 2, limit, -limit, limit))
    if model.pwm_slope is not None:
        items.append(Item(reg.PWM_SLOPE, 1, model.pwm_slope, 1, 255))
    if firmware >= _STARTUP_FIRMWARE:
        items.append(Item(reg.STARTUP_CONFIGURATION, 1, 0, 0, 3))
        items.append(Item(reg.BACKUP_READY, 1))
    highest = model.highest_address(firmware)
    for address, data, entries in model.indirect_blocks(firmware):
        for i in range(entries):
            items.append(Item(address + 2 * i, 2, data + i, reg.RAM, highest))
            items.append(Item(data + i, 1, 0, 0, 255))
    return sorted(items, key=lambda item: item.address)


class ControlTable:
    """Memory of all registers, accessed by register or by address range.

    Addresses between registers read as 0. The servo may write directly to ``memory``.
    """

    def __init__(self, model: ServoModel, firmware: int) -> None:
        self.at = {item.address: item for item in _items_of(model, firmware)}
        self.size = model.highest_address(firmware) + 1
        self.memory = bytearray(self.size)
        self._modes = model.modes
        self._indirect = {
            data + i: address + 2 * i
            for address, data, entries in model.indirect_blocks(firmware)
            for i in range(entries)
        }
        self.reset()

    # --- values ----------------------------------------------------------------------------------

    def get(self, address: int) -> int:
        """Return the value of the register at ``address``."""
        item = self.at[address]
        data = self.memory[address : address + item.size]
        return int.from_bytes(data, "little", signed=item.signed)

    def set(self, address: int, value: int) -> None:
        """Store a value regardless of access rights; bits that do not fit are dropped."""
        item = self.at[address]
        mask = (1 << 8 * item.size) - 1
        self.memory[address : address + item.size] = (value & mask).to_bytes(item.size, "little")

    def reset(self, keep: tuple[int, ...] = (), first: int = 0) -> None:
        """Restore the defaults from address ``first`` onwards, except for the items in ``keep``.

        If ``first`` is `control_table.RAM`, the reset has the same effect as a power-up.
        """
        for item in self.at.values():
            if item.address >= first and item.address not in keep:
                self.set(item.address, item.default)

    # --- reading ---------------------------------------------------------------------------------

    def resolve(self, address: int) -> int:
        """Resolve the address of a byte. An indirect data byte refers to another address."""
        pointer = self._indirect.get(address)
        if pointer is None:
            return address
        return self.memory[pointer] | self.memory[pointer + 1] << 8

    def read(self, address: int, length: int) -> bytes:
        """Return the bytes of an address range, with indirect data resolved."""
        return bytes(self.memory[self.resolve(i)] for i in range(address, address + length))

    def reads(self, address: int, length: int, first: int, last: int) -> bool:
        """Return True if the range includes any address from ``first`` to ``last``."""
        return any(first <= self.resolve(i) <= last for i in range(address, address + length))

    # --- writing ---------------------------------------------------------------------------------

    def plan(self, address: int, data: bytes) -> tuple[int, list[tuple[Item, int]]]:
        """Return the error number of a write, and the written items with their new values.

        The error is DATA_LENGTH if an item is written only partially, and ACCESS if a byte is
        read-only or undefined. The error is DATA_RANGE if a value is outside the item's range. If
        there is an error, the caller must not change any item.
        """
        if address + len(data) > self.size:
            return framing.ACCESS, []
        places = [self.resolve(address + i) for i in range(len(data))]
        plan: list[tuple[Item, int]] = []
        i = 0
        while i < len(data):
            item = self.at.get(places[i])
            if item is None or not item.writable:
                return framing.ACCESS, []
            if places[i : i + item.size] != list(range(places[i], places[i] + item.size)):
                return framing.DATA_LENGTH, []
            value = int.from_bytes(data[i : i + item.size], "little", signed=item.signed)
            plan.append((item, value))
            i += item.size
        if not all(item.low <= value <= item.high for item, value in plan):
            return framing.DATA_RANGE, plan
        refusals = (self._refusal(item, value) for item, value in plan)
        return next(filter(None, refusals), framing.OK), plan

    def _refusal(self, item: Item, value: int) -> int:
        """Return the error number if other registers prohibit writing ``value``, otherwise OK."""
        memory, address = self.memory, item.address
        if address in _GOALS:
            if memory[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR:
                return framing.DATA_RANGE
            return framing.OK if self._within_limit(address, value) else framing.DATA_LIMIT
        if address < reg.RAM and memory[reg.TORQUE_ENABLE]:
            return framing.ACCESS
        if address == reg.OPERATING_MODE and value not in self._modes:
            return framing.DATA_RANGE
        if address == reg.BUS_WATCHDOG and value and memory[address] == reg.WATCHDOG_ERROR:
            return framing.DATA_RANGE
        if address == reg.TORQUE_ENABLE and value and self.shut_down:
            return framing.RESULT_FAIL
        if address in _PAIRS and value > self.get(_PAIRS[address]):
            return framing.DATA_LIMIT
        if address in _UPPER and value < self.get(_UPPER[address]):
            return framing.DATA_LIMIT
        return framing.OK

    def _within_limit(self, address: int, value: int) -> bool:
        if address != reg.GOAL_POSITION:
            return abs(value) <= self.get(_LIMITS[address])
        if self.memory[reg.OPERATING_MODE] != reg.POSITION_MODE:
            return True
        low, high = self.get(reg.MIN_POSITION_LIMIT), self.get(reg.MAX_POSITION_LIMIT)
        return low <= value <= high

    @property
    def shut_down(self) -> bool:
        """True while a hardware error in the shutdown mask keeps torque off."""
        return bool(self.memory[reg.HARDWARE_ERROR_STATUS] & self.memory[reg.SHUTDOWN])
