"""Which writes an emulated servo refuses because of what its other registers say.

Access rights and ranges that one register has by itself stand in its control table. Pure: nothing
is written here.
"""

from __future__ import annotations

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.simulation.servo_model import protocol
from softfinger.daemon.simulation.servo_model.control_table import ControlTable, Item

_GOALS = (reg.GOAL_PWM, reg.GOAL_CURRENT, reg.GOAL_VELOCITY, reg.GOAL_POSITION)
_LIMITS = {
    reg.GOAL_PWM: reg.PWM_LIMIT,
    reg.GOAL_CURRENT: reg.CURRENT_LIMIT,
    reg.GOAL_VELOCITY: reg.VELOCITY_LIMIT,
}
# Register → (its partner, whether it must be the smaller of the two).
_PAIRS = {
    reg.MIN_POSITION_LIMIT: (reg.MAX_POSITION_LIMIT, True),
    reg.MAX_POSITION_LIMIT: (reg.MIN_POSITION_LIMIT, False),
    reg.MIN_VOLTAGE_LIMIT: (reg.MAX_VOLTAGE_LIMIT, True),
    reg.MAX_VOLTAGE_LIMIT: (reg.MIN_VOLTAGE_LIMIT, False),
}


def shut_down(table: ControlTable) -> bool:
    """Whether a hardware error that the shutdown mask has keeps torque off."""
    memory = table.memory
    return bool(memory[reg.HARDWARE_ERROR_STATUS] & memory[reg.SHUTDOWN])


def refusal(table: ControlTable, model: ServoModel, item: Item, value: int) -> int:
    """The error number that writing ``value`` is met with, OK when it is allowed."""
    memory, address = table.memory, item.address
    if address in _GOALS:
        if memory[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR:
            return protocol.DATA_RANGE
        return protocol.OK if _within_limit(table, address, value) else protocol.DATA_LIMIT
    if item.saved and memory[reg.TORQUE_ENABLE]:
        return protocol.ACCESS
    if address == reg.OPERATING_MODE and value not in model.modes:
        return protocol.DATA_RANGE
    if address == reg.BUS_WATCHDOG and value and memory[address] == reg.WATCHDOG_ERROR:
        return protocol.DATA_RANGE
    if address == reg.TORQUE_ENABLE and value and shut_down(table):
        return protocol.RESULT_FAIL
    if address in _PAIRS:
        partner, smaller = _PAIRS[address]
        other = table.get(partner)
        fits = value <= other if smaller else value >= other
        return protocol.OK if fits else protocol.DATA_LIMIT
    return protocol.OK


def _within_limit(table: ControlTable, address: int, value: int) -> bool:
    if address != reg.GOAL_POSITION:
        return abs(value) <= table.get(_LIMITS[address])
    if table.memory[reg.OPERATING_MODE] != reg.POSITION_MODE:
        return True
    low, high = table.get(reg.MIN_POSITION_LIMIT), table.get(reg.MAX_POSITION_LIMIT)
    return low <= value <= high
