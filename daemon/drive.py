"""The servos as the loop drives them: torque on and off, and tried again where off fails.

Holds who may believe what about torque: from the moment it is asked for it counts as on, until the
servos have answered that it is off.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from daemon.records import State
from daemon.safety import Safety
from daemon.servos.base import ServoError, Servos

_RETRY = 0.5  # s between two tries to turn torque off


class Drive:
    """One hand's servos, or none. It tells ``state.torque`` and ``state.write_error``."""

    def __init__(
        self,
        servos: Servos | None,
        state: State,
        safety: Safety,
        fail: Callable[[str], None],
        emit: Callable[[str, str, str], None],
    ) -> None:
        """``fail`` latches a fault for a reason, ``emit`` tells an event."""
        self.servos = servos
        self._state = state
        self._safety = safety
        self._fail = fail
        self._emit = emit
        self._off_again = False  # torque off is asked for although the state says so already
        self._next_try = -math.inf  # when torque off may be tried again after it failed

    def write(self, wanted: bool, now: float) -> None:
        """Bring torque to what is ``wanted`` at this tick, and the goal to the servos."""
        state, servos = self._state, self.servos
        if servos is None:
            return
        if wanted and not state.torque:
            self._on(servos)
        elif not wanted and (state.torque or self._off_again):
            self._off_again = False
            self._off(servos)
        elif wanted and state.goal.valid:
            state.goal.seq = state.seq
            state.goal.t = now
            try:
                self._safety.write(servos, state)
            except ServoError as error:
                self._fall(servos, error)

    def forget(self) -> None:
        """Turn torque off at the next tick whatever the state says: another may have put it on."""
        self._off_again = True
        self._next_try = -math.inf

    def end(self) -> None:
        """Turn torque off now if it may be on."""
        self._next_try = -math.inf
        if self.servos is not None and self._state.torque:
            self._off(self.servos)

    def _on(self, servos: Servos) -> None:
        self._state.torque = True  # from here on it may be on, whatever the servos answer
        try:
            servos.set_torque(True)
        except ServoError as error:
            self._fall(servos, error)

    def _fall(self, servos: Servos, error: ServoError) -> None:
        self._state.write_error = str(error)
        self._fail(str(error))
        self._off(servos)

    def _off(self, servos: Servos) -> None:
        """Turn torque off; when that fails, again every half second. The first failure is told."""
        state = self._state
        if state.t < self._next_try:
            return
        state.torque = True  # as far as is known, until they have answered
        try:
            servos.set_torque(False)
        except ServoError as error:
            state.write_error = str(error)
            if self._next_try < 0.0:
                self._emit("error", "servos", f"torque could not be turned off: {error}")
            self._next_try = state.t + _RETRY
        else:
            state.torque = False
            self._next_try = -math.inf

    def reconnect(self) -> None:
        """Connect servos that have gone silent anew, as after an unplug. Raises ServoError."""
        state, servos = self._state, self.servos
        if servos is None:
            return
        servos.connect()
        servos.read(state.reading)
        if state.torque:
            # It may still be on where the port went away before it could be turned off.
            servos.set_torque(False)
            state.torque = False
