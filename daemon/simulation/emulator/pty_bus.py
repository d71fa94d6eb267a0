"""A servo bus behind a pseudo-terminal, served by somebody else's event loop.

It owns the terminal and the time on the wire: replies leave when their last byte would have
arrived at the client's baud rate, return delays included; or at once, unpaced. Times on the wire
are absolute: time in which this process did not run, which no servo ever loses, does not count.
"""

from __future__ import annotations

import fcntl
import heapq
import math
import os
import pty
import struct
import time
import tty
from collections.abc import Callable

from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus

_TCGETS2 = 0x802C542A  # struct termios2: four flag words, line, 19 control characters, two speeds
_TERMIOS2 = struct.Struct("=4IB19s2I")
_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_READ_SIZE = 4096
_AT_A_TIME = 4  # reads, so that a client that never pauses leaves time for the rest of the hand
_GAP = 0.02  # s of silence within a packet that drop it: the reader may be held up beyond 1.5 ms
# s: about what a pseudo-terminal takes from one process's write to the other's read, woken by it.
# A paced bus takes it off both ways, since it stands for a wire that has its own time already.
PASSAGE = 15e-6
# s by which what a reading shows may be older than its reply, as in a servo, which measures at
# intervals of its own: so that the physics is computed beside the exchange, not within it.
_LAG = 0.0005


def open_pty() -> tuple[int, int, str]:
    """Return a new pty: its non-blocking end, the clients' one, which is raw, and that one's path.

    The clients' end stays open here, so that they may come and go without an error.
    """
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    return master, slave, os.ttyname(slave)


class PtyServoBus:
    """``bus`` on a new pseudo-terminal at ``path``.

    The loop that owns it waits until :meth:`fileno` is readable or :meth:`next_event` has come,
    then calls :meth:`service`; ``clock`` must be the clock that those times are of.

    Args:
        baud: 0 answers at any rate and at once. Above 0 a servo ignores a client whose port is
            set to another rate than its own, and replies take their time on the wire.
        spin: s before a paced reply is due in which :meth:`service` waits for it awake, since a
            sleep ends late by a timer's slack.
    """

    def __init__(
        self,
        bus: ServoBus,
        *,
        baud: int = 0,
        spin: float = 0.00012,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.bus = bus
        bus.parser.gap = _GAP
        bus.lag = _LAG
        self._baud = baud
        self._spin = spin
        self._clock = clock
        self._free_at = -math.inf  # the wire is busy until then
        self._due: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._arrives = -math.inf  # when the last reply has arrived
        self.plug()

    def fileno(self) -> int:
        """Return the descriptor to wait for; -1 while unplugged."""
        return self._master

    @property
    def plugged(self) -> bool:
        """True if the terminal exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Make the terminal (again), at a new ``path``."""
        self._master, self._slave, self.path = open_pty()

    def unplug(self) -> None:
        """Take the terminal away, as when an adapter is pulled; the servos go on."""
        self._due.clear()
        self.bus.parser.reset()
        if self.plugged:
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    def client_baud(self) -> int:
        """Return the rate that the terminal is set to."""
        raw = bytearray(_TERMIOS2.size)
        fcntl.ioctl(self._master, _TCGETS2, raw, True)
        return int(_TERMIOS2.unpack(raw)[-1])

    def next_event(self) -> float:
        """Return when :meth:`service` is needed next [s] though no byte came."""
        servos = self.bus.next_event()
        return min(servos, self._due[0][0] - self._spin) if self._due else servos

    @property
    def answering_until(self) -> float:
        """Time [s] at which the last reply, but one that a fault holds back, has arrived."""
        return self._arrives

    def driven(self) -> bool:
        """Return whether torque is on and a process has the port for itself, as the daemon does."""
        if not (self.plugged and any(servo.torque_on for servo in self.bus.servos)):
            return False
        try:
            fcntl.flock(self._slave, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._slave, fcntl.LOCK_UN)
        return False

    def service(self, t: float) -> None:
        """Take what has arrived by time t [s], let the servos act, send what is due."""
        if self.plugged:
            for _ in range(_AT_A_TIME):
                try:
                    data = os.read(self._master, _READ_SIZE)
                except OSError:  # nothing there
                    break
                if self._receive(data, t):
                    break  # the client takes some time for the reply
                # Its next request often comes while its last write is being done.
                t = max(t, self._clock())
        self.bus.advance(t)
        self._send()

    def _receive(self, data: bytes, t: float) -> bool:
        """Let the servos act on ``data``; whether there is a reply."""
        if not self._baud:
            replies = self.bus.exchange(data, t)
            for reply in replies:
                if reply.late:
                    self._queue(t + reply.late, reply.data)
                else:
                    self._write(reply.data)
            return bool(replies)
        baud = self.client_baud()
        if baud <= 0:
            return False
        byte_time = _BITS_PER_BYTE / baud
        free_at = max(self._free_at, t - PASSAGE) + len(data) * byte_time
        replies = self.bus.exchange(data, t, baud)
        for reply in replies:
            free_at += reply.delay + len(reply.data) * byte_time
            due = free_at + reply.late
            self._queue(due - PASSAGE, reply.data)
            if not reply.late:
                self._arrives = due
        self._free_at = free_at
        return bool(replies)

    def _queue(self, due: float, data: bytes) -> None:
        heapq.heappush(self._due, (due, self._order, data))
        self._order += 1

    def _send(self) -> None:
        while self._due:
            now = self._clock()
            due = self._due[0][0]
            if now < due - self._spin:
                return
            while now < due:
                before, now = now, self._clock()
                if now == before:  # the hand's time stands still
                    return
            self._write(heapq.heappop(self._due)[2])

    def _write(self, data: bytes) -> None:
        # A client that never reads fills the terminal; a wire would lose those bytes too.
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass
