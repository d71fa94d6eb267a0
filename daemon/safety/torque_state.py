"""Track the torque state.

A torque-on request sets the state to on, but only a confirmation by the servos sets it to off.
The torque-off request is repeated on every tick until the servo registers confirm that torque is
off. If the confirmation does not arrive within half the watchdog time, the daemon keeps the bus
silent. The silence trips the watchdogs, which stop the motors. A servo that still received read
requests would keep driving its motor. After the silence, the daemon requests torque off again.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.safety.safety import BUS, TORQUE_OFF, Safety
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.servos.control_table import WATCHDOG_UNIT
from softfinger.daemon.types import EventSink, Reading, State

# Duration of repeated torque-off attempts, as a fraction of the watchdog time. After the attempts,
# the bus is kept silent.
_TRY_FRACTION = 0.5
_TRY_TIME_UNGUARDED = 0.05  # duration of the torque-off attempts if servos.watchdog is 0 [s]
_CLOSING_TRY_COUNT = 15  # number of torque-off attempts at shutdown


class TorqueState:
    """Torque controller that sets ``torque``, ``torque_off`` and ``write_error`` in the state."""

    def __init__(
        self,
        servos: Servos | None,
        settings: ServoSettings,
        state: State,
        safety: Safety,
        fail: Callable[[str, str], None],
        emit: EventSink,
    ) -> None:
        """Create the controller.

        ``fail(reason, name)`` latches a fault under the name of a limit. ``emit`` sends an event.
        """
        self.servos = servos
        self._state = state
        self._safety = safety
        self._fail = fail
        self._emit = emit
        watchdog = settings.watchdog
        self._try_time = _TRY_FRACTION * watchdog or _TRY_TIME_UNGUARDED
        # A servo's watchdog counts whole units of time and may trip one unit late.
        units = math.ceil(watchdog / WATCHDOG_UNIT - 1e-9) + 1 if watchdog else 0
        self._silence = units * WATCHDOG_UNIT
        self._tried_since = math.inf  # start time of the present series of torque-off attempts [s]
        self._silent_until = -math.inf
        self._first = math.inf  # time of the first request to turn torque off [s]
        self._reported = False
        self._port_gone = False  # True if the port is lost and the daemon cannot send anything
        self._last_try = -1  # sequence number of the tick of the last torque-off attempt
        self._unused = Reading()  # buffer for discarded readings

    @property
    def pending(self) -> bool:
        """True while torque off has been requested but not confirmed."""
        return self._tried_since < math.inf

    def read(self) -> None:
        """Read the servos. A pending torque-off request is repeated in the same bus exchange.

        Raises ServoError like `Servos.read`.
        """
        state, servos = self._state, self.servos
        state.torque_off = False
        if servos is None:
            return
        if not self.pending:
            servos.read(state.reading)
        elif self._is_silent():
            state.reading.valid = False
        else:
            self._try(servos, state.reading)

    def write(self, requested: bool) -> None:
        """Switch torque on or off as ``requested``. While torque is on, send the goal."""
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
            state.goal.t = state.t
            try:
                self._safety.write(servos, state)
            except ServoError as error:
                self._fall(error)

    def off(self) -> str:
        """Request torque off immediately; return "confirmed" or "unconfirmed".

        The call waits for at most one reply. Each tick repeats the request until the servos confirm
        torque off.
        """
        state, servos = self._state, self.servos
        if servos is None:
            return "confirmed"
        first = not self.pending
        if first:
            state.torque = True  # Another program may have switched torque on.
            self._first = self._tried_since = state.t
            self._silent_until = -math.inf
        if self._last_try != state.seq and (first or not self._is_silent()):
            try:
                self._try(servos, self._unused)
            except ServoError as error:
                state.write_error = str(error)
        return "unconfirmed" if state.torque else "confirmed"

    def end(self) -> None:
        """Turn torque off if it may be on.

        If torque cannot be turned off, the silent bus trips the servo watchdogs.
        """
        for _ in range(_CLOSING_TRY_COUNT):
            if not self._state.torque:
                return
            self._last_try = -1
            self.off()

    def reconnect(self) -> None:
        """Reconnect servos that have stopped responding, for example because they were unplugged.

        Raises ServoError.
        """
        if self.servos is None:
            return
        self.servos.connect()
        self.servos.read(self._state.reading)
        if self._state.torque:
            # Torque may still be on if the port was lost before torque could be turned off.
            self._last_try = -1
            self.off()

    def _on(self, servos: Servos) -> None:
        self._state.torque = True  # From here on, torque may be on, regardless of the reply.
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
        self._port_gone = True
        confirmed = servos.torque_off(reading)
        self._port_gone = False
        if not confirmed:
            return
        state = self._state
        state.torque, state.torque_off = False, True
        self._tried_since = math.inf
        if self._reported:
            self._reported = False
            waited = state.t - self._first
            text = f"the servos confirmed after {waited:.2f} s that torque is off"
            self._emit("info", TORQUE_OFF, text)

    def _is_silent(self) -> bool:
        """Return True if the bus must stay silent on this tick to trip the servo watchdogs."""
        t = self._state.t
        if t < self._silent_until:
            return True
        if t - self._tried_since < self._try_time:
            return False
        self._report()
        silence = 0.0 if self._port_gone else self._silence
        self._silent_until = self._tried_since = t + silence
        return silence > 0.0

    def _report(self) -> None:
        """Report, only once, that torque off is not confirmed; latch a fault if there is none."""
        if self._reported:
            return
        self._reported = True
        state = self._state
        waited = state.t - self._first
        text = f"the servos did not confirm within {waited:.2f} s that torque is off: "
        if not self._silence:
            text += (
                "switch off their supply, because servos.watchdog = 0 disables the watchdogs "
                "that would stop them"
            )
        elif self._port_gone:
            text += "the port is lost; the watchdogs will stop the servos"
        else:
            text += "the daemon keeps the bus silent until the watchdogs stop the servos"
        if state.fault:
            self._emit("error", TORQUE_OFF, text)
        else:
            self._fail(text, TORQUE_OFF)
