"""Heat and supply of a simulated servo: the plant behind its thermometer and its voltmeter.

Written apart from the daemon's own model (`kinematics.hand.servo_heat`), with other constants:
copper's resistance rises, the case cools by convection, which grows with what it is warmer, and the
thermometer on the board lags behind the case.
"""

from __future__ import annotations

from typing import Self

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import ServoModel, by_name

ROOM = 25.0  # °C
_LAG = 4.0  # s, of the thermometer
_CONVECTION = 0.006  # 1/K that the cooling grows by
_LONGEST = 1.0  # s of a step


class ServoHeat:
    """One servo. ``ambient`` [°C] may be changed at any time.

    ``heating``, ``cooling`` and ``capacity`` are factors of the model's own.
    """

    def __init__(
        self, model: ServoModel, heating: float = 1.0, cooling: float = 1.0, capacity: float = 1.0
    ) -> None:
        self.ambient = self.winding = self.case = self.sensed = ROOM
        self._resistance = 1.08 * heating * model.resistance
        self._winding = 0.05 * capacity * model.heat_capacity  # J/K
        self._case = 0.93 * capacity * model.heat_capacity
        self._coupling = 1.0 / (0.35 * model.case_resistance)  # W/K
        self._cooling = 0.85 * cooling / model.case_resistance

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return a servo of the settings' model, as warm as the room."""
        simulation = settings.simulation
        heat = cls(by_name(settings.servos.model), *simulation.servo_heat)
        heat.ambient = simulation.ambient
        heat.cool()
        return heat

    def cool(self) -> None:
        """Bring all of it to the ambient temperature."""
        self.winding = self.case = self.sensed = self.ambient

    def warm(self, temperature: float) -> None:
        """Bring all of it to this temperature [°C]."""
        self.winding = self.case = self.sensed = temperature

    def step(self, current: float, seconds: float) -> None:
        """Go on by ``seconds`` with this ``current`` [A]."""
        while seconds > 0.0:
            dt = min(seconds, _LONGEST)
            seconds -= dt
            copper = 1.0 + 0.0039 * (self.winding - ROOM)
            inward = self._coupling * (self.winding - self.case)
            over = self.case - self.ambient
            outward = self._cooling * (1.0 + _CONVECTION * max(over, 0.0)) * over
            heat = self._resistance * copper * current * current
            self.winding += (heat - inward) * dt / self._winding
            self.sensed += (self.case - self.sensed) * dt / _LAG
            self.case += (inward - outward) * dt / self._case
