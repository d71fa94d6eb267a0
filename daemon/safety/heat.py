"""Predict servo overheating, and reduce the grip force early enough to prevent it.

The module predicts when a servo will reach ``safety.temperature_max``. If the remaining time is
less than ``heat_warn``, `safety.limits` issues a warning. The grip force is then reduced to the
highest force that the servo can sustain indefinitely. The grip force is never reduced below the
force required for the load, including the slip margin. If the load does not allow a sufficient
reduction, an error is reported _ERROR_TIME seconds before the servo reaches the limit.
``heat_action`` is performed _ACTION_TIME seconds before the limit. The reduced force applies until
the grip ends, even if a client commands another force.
"""

from __future__ import annotations

import math

from softfinger.daemon.control.state_machine import Control, Gripping
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.types import FINGERS, State
from softfinger.kinematics.hand.servo_heat import (
    AMBIENT,
    CASE,
    WINDING,
    HeatLaw,
    HeatState,
    follow,
    sustained_square,
    time_to_limit,
    winding_std,
)

_UPDATE_INTERVAL = 0.5  # time between thermal model updates [s]
# Longest gap between two readings that is simulated [s]. After an hour, the temperatures have
# settled, and simulating the hour takes about 10 ms.
_GAP_MAX = 3600.0
_AVERAGING_TIME = 5.0  # averaging time for the squared current [s]
# Half the thermometer's resolution [°C]. A rounded reading may exceed the actual temperature by
# half the resolution.
_HALF_STEP = 0.5
_TARGET_MARGIN = 3.0  # margin between the temperature limit and the target temperature [°C]
_FRACTION_MAX = 0.97  # maximum ratio of new to old force; minor reductions are skipped
_FRACTION_MIN = 0.6  # minimum ratio of new to old force; the first estimate is uncertain
_SETTLING_TIME = 10.0  # time between a force reduction and the next evaluation [s]
_ERROR_TIME, _ACTION_TIME = 30.0, 3.0  # s
# Fraction of the total heat capacity in the winding, and fraction of the total thermal resistance
# between winding and case.
_WINDING_SHARE, _COUPLING_SHARE = 0.04, 0.4


def set_law(law: HeatLaw, settings: Settings) -> tuple[float, float]:
    """Set the thermal parameters from the settings or, by default, from the servo model.

    Returns
    -------
    Case temperature rise [K/A²] and time constant [s].
    """
    servos = settings.servos
    model = by_name(servos.model)
    rise = servos.heat_rise or model.case_resistance * model.resistance
    time = servos.heat_time or model.case_resistance * model.heat_capacity
    law.share = _WINDING_SHARE / (1.0 - _WINDING_SHARE)
    law.case_time = (1.0 - _WINDING_SHARE) * time
    law.winding_time = _WINDING_SHARE * _COUPLING_SHARE * time
    law.heating = rise / (_WINDING_SHARE * time)
    return rise, time


class HeatWatch:
    """Temperature monitor for the servos of a hand. Only the loop thread may use this class."""

    def __init__(self, settings: Settings, state: State) -> None:
        """Create a monitor that reads ``state.reading`` and updates ``state.heat``."""
        self._limits = settings.safety
        self._state = state
        self._fingers = settings.scene.indices
        self._states = [HeatState(), HeatState()]
        for each in self._states:
            set_law(each.law, settings)
        self._heat = [0.0, 0.0]  # ∫ I² dt since the last update [A² s]
        self._square = [0.0, 0.0]  # low-pass filtered squared current [A²]
        self._t = math.nan  # time of the last reading [s]
        self._elapsed = 0.0  # time since the last update [s]
        self._reduction_time = -math.inf  # time of the last force reduction [s]
        self._error_reported = False  # True if an insufficient reduction has been reported
        self.due = False  # True if the model was updated on this tick

    def update(self) -> None:
        """Add the newest servo reading, and update the thermal model if an update is due."""
        reading = self._state.reading
        dt = reading.t - self._t
        self._t = reading.t
        self.due = False
        if not 0.0 < dt < math.inf:  # The first reading may have failed, so its time is −∞.
            return
        for i in self._fingers:
            self._heat[i] += reading.current[i] * reading.current[i] * dt
        self._elapsed += dt
        if self._elapsed >= _UPDATE_INTERVAL:
            self._update()

    def _update(self) -> None:
        passed, self._elapsed = self._elapsed, 0.0
        self.due = True
        for i in self._fingers:
            square, self._heat[i] = self._heat[i] / passed, 0.0
            self._square[i] += (square - self._square[i]) * min(passed / _AVERAGING_TIME, 1.0)
            if not self._state.reading.temperature[i]:
                continue  # No temperature has been read yet.
            # After a long gap between readings, use several steps that are short enough for the
            # winding's time constant.
            for _ in range(max(round(min(passed, _GAP_MAX) / _UPDATE_INTERVAL), 1)):
                step = min(passed, _UPDATE_INTERVAL)
                follow(self._states[i].array, square, step, self._state.reading.temperature[i])
            heat, estimate = self._states[i], self._state.heat[i]
            temperatures = heat.x[[WINDING, CASE, AMBIENT]].tolist()
            estimate.winding, estimate.case, estimate.ambient = temperatures
            estimate.winding_std = winding_std(heat)
            estimate.case_std = math.sqrt(heat.p.item(CASE, CASE))
            limit = self._limits.temperature_max - _HALF_STEP
            estimate.time_to_limit = time_to_limit(heat.array, self._square[i], limit)

    def act(self, control: Control) -> str:
        """Reduce the grip force if a servo is about to overheat.

        Return ``heat_action`` if the action is due, otherwise "".
        """
        state = self._state
        i = min(self._fingers, key=lambda k: state.heat[k].time_to_limit)
        left = state.heat[i].time_to_limit
        if not isinstance(control.state, Gripping) or left > self._limits.heat_warn:
            self._error_reported = False
            return ""
        hot = self._limits.temperature_max
        who = f"the {FINGERS[i]} servo will reach {hot:g} °C in {left:.0f} s"
        if state.t - self._reduction_time < _SETTLING_TIME and left > _ACTION_TIME:
            return ""  # The last reduction has not taken effect yet.
        now = state.goal.force
        square = sustained_square(self._states[i], hot - _TARGET_MARGIN)
        lasts = now * math.sqrt(square / max(self._square[i], 1e-6))
        eased = max(min(lasts, now), _FRACTION_MIN * now, control.grip.force_for_load())
        if eased < _FRACTION_MAX * now:
            self._reduction_time = state.t
            control.limit_force(eased, _ACTION_TIME)
            text = f"{who}: the grip force was reduced from {now:.1f} to {eased:.1f} N"
            control.events.append(("warning", "servos.heat", text))
            return ""
        if left > _ERROR_TIME:
            return ""
        action = self._limits.heat_action
        if not self._error_reported:
            self._error_reported = True
            text = (
                f"{who}, and the load does not allow a lower grip force; safety.heat_action = "
                f"{action}"
            )
            control.events.append(("error", "servos.heat", text))
        return action if left < _ACTION_TIME and action != "hold" else ""
