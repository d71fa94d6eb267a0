"""Each servo's heat foreseen: told before it shuts down, and a grip eased to what lasts.

Where a servo comes to ``safety.temperature_max`` within ``heat_warn``, `safety.limits` warns, and a
grip is eased to the force with which it never would, but not below what its load needs with the
margin against slip. Where that is not enough it is told _AHEAD, and ``heat_action`` is done in the
last _LAST. A grip that was eased stays so until it ends, whatever force is asked for.
"""

from __future__ import annotations

import math

from softfinger.daemon.control.modes import GRIPPING
from softfinger.daemon.control.state_machine import Control
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.types import FINGERS, Event, State
from softfinger.kinematics.hand.servo_heat import (
    AMBIENT,
    CASE,
    WINDING,
    HeatLaw,
    HeatState,
    follow,
    lasting_square,
    time_to_limit,
    winding_std,
)

_EVERY = 0.5  # s between two looks
_SMOOTH = 5.0  # s over which the current's square is averaged
_STEP = 0.5  # °C: a reading comes to the limit so much before the case
_BELOW = 3.0  # °C below the limit, where an eased grip is to settle
_EASED = 0.97  # of the force before: less is no easing
_AT_ONCE = 0.6  # of it at least, since what lasts is not known well at first
_SETTLES = 10.0  # s after which an eased grip is judged again
_AHEAD, _LAST = 30.0, 3.0  # s
_WINDING, _COUPLING = 0.04, 0.4  # of a servo's heat capacity, and of its thermal resistance


def set_law(law: HeatLaw, settings: Settings) -> tuple[float, float]:
    """Fill in what the servo's model, or its own calibration, has: what [K/A²] in what time [s]."""
    servos = settings.servos
    model = by_name(servos.model)
    rise = servos.heat_rise or model.case_resistance * model.resistance
    time = servos.heat_time or model.case_resistance * model.heat_capacity
    law.share = _WINDING / (1.0 - _WINDING)
    law.case_time = (1.0 - _WINDING) * time
    law.winding_time = _WINDING * _COUPLING * time
    law.heating = rise / (_WINDING * time)
    return rise, time


class HeatWatch:
    """Heat of a scene's servos. One thread, the loop's, may call it."""

    def __init__(self, settings: Settings, state: State) -> None:
        """``state``: its readings are read, its ``heat`` is written."""
        self._limits = settings.safety
        self._state = state
        self._fingers = [FINGERS.index(name) for name in sorted(settings.scene.fingers)]
        self._states = [HeatState(), HeatState()]
        if settings.servos.backend != "none":
            for each in self._states:
                set_law(each.law, settings)
        self._heat = [0.0, 0.0]  # ∫ I² since the last look [A² s]
        self._square = [0.0, 0.0]  # its mean, averaged [A²]
        self._t = math.nan  # of the last reading [s]
        self._passed = 0.0  # s since the last look
        self._eased = -math.inf  # when [s]
        self._told = False  # that easing is not enough
        self.due = False  # it was looked at this tick

    def follow(self) -> None:
        """Take in this tick's reading."""
        reading = self._state.reading
        dt = reading.t - self._t
        self._t = reading.t
        self.due = False
        if not dt > 0.0:
            return
        for i in self._fingers:
            self._heat[i] += reading.current[i] * reading.current[i] * dt
        self._passed += dt
        if self._passed >= _EVERY:
            self._look()

    def _look(self) -> None:
        passed, self._passed = self._passed, 0.0
        self.due = True
        for i in self._fingers:
            square, self._heat[i] = self._heat[i] / passed, 0.0
            self._square[i] += (square - self._square[i]) * min(passed / _SMOOTH, 1.0)
            if not self._state.reading.temperature[i]:
                continue  # not known yet
            # In steps that suit the winding's time, however long nothing was read.
            for _ in range(max(round(passed / _EVERY), 1)):
                step = min(passed, _EVERY)
                follow(self._states[i].array, square, step, self._state.reading.temperature[i])
            heat, told = self._states[i], self._state.heat[i]
            told.winding, told.case, told.ambient = heat.x[[WINDING, CASE, AMBIENT]].tolist()
            told.winding_std = winding_std(heat.array)
            told.case_std = math.sqrt(heat.p.item(CASE, CASE))
            limit = self._limits.temperature_max - _STEP
            told.time_to_limit = time_to_limit(heat.array, self._square[i], limit)

    def act(self, control: Control, events: list[Event]) -> str:
        """Ease a grip that gets too hot; return what `heat_action` wants done now, else ''."""
        state = self._state
        if state.mode not in GRIPPING:
            self._told = False
            return ""
        i = min(self._fingers, key=lambda k: state.heat[k].time_to_limit)
        left = state.heat[i].time_to_limit
        if left > self._limits.heat_warn:
            self._told = False
            return ""
        who = f"{FINGERS[i]} servo at {self._limits.temperature_max:g} °C in {left:.0f} s"
        if state.t - self._eased < _SETTLES and left > _LAST:
            return ""  # what easing brings is not seen yet
        now = state.goal.force
        square = lasting_square(self._states[i].array, self._limits.temperature_max - _BELOW)
        lasts = now * math.sqrt(square / max(self._square[i], 1e-6))
        eased = max(min(lasts, now), _AT_ONCE * now, control.grip.load_needs())
        if eased < _EASED * now:
            self._eased = state.t
            control.ease(eased, _LAST)
            text = f"{who}: grip eased from {now:.1f} to {eased:.1f} N"
            events.append(("warning", "servos.heat", text))
            return ""
        if left > _AHEAD:
            return ""
        action = self._limits.heat_action
        if not self._told:
            self._told = True
            text = f"{who}, and the load needs the grip: {action}"
            events.append(("error", "servos.heat", text))
        return action if left < _LAST and action != "hold" else ""
