"""What an emulated servo suffers: heat of its motor, its supply, overload. No register is written.

Choices of our own, where the manuals say nothing: one thermal time constant, heat with the square
of the current, overload after OVERLOAD_TIME of current at the configured limit.
"""

from __future__ import annotations

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.simulation.servo_model.registers import ControlTable

OVERLOAD_TIME = 2.0  # s at the current limit
SENSE = 0.010  # s between two looks
_VOLTAGE, _HEAT, _OVERLOAD = 0, 2, 5  # bits of the hardware error status


class ServoHealth:
    """``voltage`` [V] and ``temperature`` [°C] may be set from outside."""

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        self._overload = 0.0  # s
        self.recover()

    def recover(self) -> None:
        """Cool, and the supply as it should be."""
        self.temperature = reg.AMBIENT
        self.voltage = self._model.supply

    def restart(self) -> None:
        """As after a power-up: what was warm stays warm."""
        self._overload = 0.0

    def sense(self, table: ControlTable, current: float, pressed: bool) -> list[int]:
        """SENSE later: the bits of the hardware errors that there are now.

        ``current`` [A] flows; ``pressed``: it is at the configured limit.
        """
        warmer = self._model.settled_temperature(current) - self.temperature
        self.temperature += warmer * SENSE / reg.THERMAL_TIME
        self._overload = self._overload + SENSE if pressed else 0.0
        errors = []
        if self.temperature > table.get(reg.TEMPERATURE_LIMIT):
            errors.append(_HEAT)
        low, high = table.get(reg.MIN_VOLTAGE_LIMIT), table.get(reg.MAX_VOLTAGE_LIMIT)
        if not low <= round(self.voltage / reg.VOLTAGE_UNIT) <= high:
            errors.append(_VOLTAGE)
        if self._overload >= OVERLOAD_TIME:
            errors.append(_OVERLOAD)
        return errors
