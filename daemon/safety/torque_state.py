"""Tracks the confirmed torque state: on from the request on, off once the servos confirm it.

Off is sent at every tick until the servos' own registers say so. Where they do not within half of
their bus watchdog's time, nothing is sent for as long as that watchdog takes to stop the motors: a
servo that receives read requests but loses all writes would drive on. Then it is tried again.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.safety.safety import BUS, TORQUE_OFF, Safety
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.servos.control_table import WATCHDOG_UNIT
from softfinger.daemon.types import Reading, State

_TRY = 0.5  # of the watchdog's time in which torque off is tried before the bus falls silent
_TRY_UNGUARDED = 0.05  # s of tries before a report, with servos.watchdog = 0
_LAST_TRIES = 15  # when the daemon ends


class TorqueState:
    """Torque of one hand's servos. Writes ``state.torque``, ``torque_off`` and ``write_error``."""

    def __init__(
        self,
        servos: Servos | None,
        settings: ServoSettings,
        state: State,
        safety: Safety,
        fail: Callable[[str, str], None],
        emit: Callable[[str, str, str], None],
    ) -> None:
        """``fail`` latches a fault by reason and limit, ``emit`` sends an event."""
        self.servos = servos
        self._state = state
        self._safety = safety
        self._fail = fail
        self._emit = emit
        watchdog = settings.watchdog
        self._patience = _TRY * watchdog or _TRY_UNGUARDED
        # The servo counts in whole units, and may be one late.
        units = math.ceil(watchdog / WATCHDOG_UNIT - 1e-9) + 1 if watchdog else 0
        self._silence = units * WATCHDOG_UNIT
        self._tried_since = math.inf  # torque off is wanted and not confirmed since then
        self._silent_until = -math.inf
        self._first = math.inf  # when off was first asked for
        self._reported = False
        self._gone = False  # the port: nothing can be sent
        self._last_try = -1  # seq of the tick with the last try
        self._unused = Reading()  # takes what is read after the tick has decided

    @property
    def pending(self) -> bool:
        """True while torque off is requested and not confirmed."""
        return self._tried_since < math.inf

    def read(self, reading: Reading) -> None:
        """Read the servos; request a pending torque off on the way. Raises ServoError."""
        state, servos = self._state, self.servos
        state.torque_off = False
        if servos is None:
            return
        if not self.pending:
            servos.read(reading)
        elif self._is_silent():
            reading.valid = False
        else:
            self._try(servos, reading)

    def write(self, requested: bool, now: float) -> None:
        """Bring torque to what is ``requested`` at this tick, and the goal to the servos."""
        state, servos = self._state, self.servos
        if servos is None:
            return
        if not requested:
            if state.torque and not self.pending:
                self.off()
        elif not state.torque:
            self._on(servos)
        elif state.goal.valid:
            state.goal.seq = state.seq
            state.goal.t = now
            try:
                self._safety.write(servos, state)
            except ServoError as error:
                self._fall(error)

    def off(self) -> str:
        """Ask for torque off now, whatever the state says; "confirmed" by the servos, or not.

        It waits for one reply at most. Where that does not come, each tick tries again.
        """
        state, servos = self._state, self.servos
        if servos is None:
            return "confirmed"
        first = not self.pending
        if first:
            state.torque = True  # as far as is known: another program may have put it on
            self._first = self._tried_since = state.t
            self._silent_until = -math.inf
        if self._last_try != state.seq and (first or not self._is_silent()):
            try:
                self._try(servos, self._unused)
            except ServoError as error:
                state.write_error = str(error)
        return "unconfirmed" if state.torque else "confirmed"

    def end(self) -> None:
        """Turn torque off now if it may be on; where that fails, the end is the bus's silence."""
        for _ in range(_LAST_TRIES):
            if not self._state.torque:
                return
            self._last_try = -1
            self.off()

    def reconnect(self) -> None:
        """Connect servos again that have gone silent, as after an unplug. Raises ServoError."""
        if self.servos is None:
            return
        self.servos.connect()
        self.servos.read(self._state.reading)
        if self._state.torque:
            # It may still be on where the port went away before it could be turned off.
            self._last_try = -1
            self.off()

    def _on(self, servos: Servos) -> None:
        self._state.torque = True  # from here on it may be on, whatever the servos answer
        try:
            servos.torque_on()
        except ServoError as error:
            self._fall(error)

    def _fall(self, error: ServoError) -> None:
        self._state.write_error = str(error)
        self._fail(str(error), BUS)
        self.off()

    def _try(self, servos: Servos, reading: Reading) -> None:
        self._last_try = self._state.seq
        self._gone = True
        confirmed = servos.torque_off(reading)
        self._gone = False
        if not confirmed:
            return
        state = self._state
        state.torque, state.torque_off = False, True
        self._tried_since = math.inf
        if self._reported:
            self._reported = False
            waited = state.t - self._first
            self._emit(
                "info", TORQUE_OFF, f"torque off confirmed by the servos after {waited:.2f} s"
            )

    def _is_silent(self) -> bool:
        """Return whether nothing may be sent at this tick, so that the servos' watchdogs act."""
        t = self._state.t
        if t < self._silent_until:
            return True
        if t - self._tried_since < self._patience:
            return False
        self._report()
        silence = 0.0 if self._gone else self._silence
        self._silent_until = self._tried_since = t + silence
        return silence > 0.0

    def _report(self) -> None:
        """Report once that torque off is not confirmed, as a fault where none is latched."""
        if self._reported:
            return
        self._reported = True
        state = self._state
        text = f"torque off not confirmed by the servos for {state.t - self._first:.2f} s: "
        if not self._silence:
            text += "cut their power (servos.watchdog = 0: nothing else stops them)"
        elif self._gone:
            text += "the port is gone, their watchdogs stop them"
        else:
            text += "the bus is kept silent until their watchdogs stop them"
        if state.fault:
            self._emit("error", TORQUE_OFF, text)
        else:
            self._fail(text, TORQUE_OFF)
