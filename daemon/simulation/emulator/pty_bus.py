"""Servo bus on a pseudo-terminal, served by an event loop of the caller.

It manages the terminal and the transmission times. A paced reply is sent at the time at which its
last byte would arrive at the client's baud rate, including the return delay. Unpaced replies are
sent at once. Transmission times are absolute, so interruptions of this process do not add to them.
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
_READS_PER_TURN = 4  # reads in one turn, so that a busy client leaves time for other tasks
# s of silence that end a packet; more than 1.5 ms, since this process may be delayed.
_GAP_TIME = 0.02
# s: typical latency of a pseudo-terminal from a write to the wake-up of the reader. A paced bus
# subtracts it in both directions, since the simulated wire has its own transmission time.
PASSAGE_TIME = 15e-6
# s by which a reading may be older than its reply. Servos also measure at intervals of their own.
# This allows the physics to be computed outside the exchange.
_LAG_TIME = 0.0005


def open_pty() -> tuple[int, int, str]:
    """Open a pty; return its non-blocking master, its raw slave for clients, and the slave's path.

    The slave stays open here, so that clients may come and go without an error.
    """
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    return master, slave, os.ttyname(slave)


class PtyServoBus:
    """Servo bus on a new pseudo-terminal at ``path``.

    The caller's event loop waits until :meth:`fileno` is readable or the time of :meth:`next_event`
    is reached, and then calls :meth:`service`.

    Parameters
    ----------
    bus
        Emulated servos.
    baud
        With 0, servos answer at any rate and at once. Otherwise a servo ignores a client whose port
        is set to a different rate than its own, and replies take transmission time.
    spin
        Duration [s] of busy waiting before a paced reply is due, since sleeps end late.
    clock
        Clock of all times.
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
        bus.parser.gap = _GAP_TIME
        bus.lag = _LAG_TIME
        self._baud = baud
        self._spin = spin
        self._clock = clock
        self._free_at = -math.inf  # the wire is busy until then
        self._due: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._arrives = -math.inf  # arrival time of the last reply
        self.plug()

    def fileno(self) -> int:
        """Return the file descriptor to wait for; -1 while unplugged."""
        return self._master

    @property
    def plugged(self) -> bool:
        """True if the terminal exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Create the terminal (again), at a new ``path``."""
        self._master, self._slave, self.path = open_pty()

    def unplug(self) -> None:
        """Remove the terminal, like an unplugged adapter; the servos continue."""
        self._due.clear()
        self.bus.parser.reset()
        if self.plugged:
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    def client_baud(self) -> int:
        """Return the baud rate of the terminal."""
        raw = bytearray(_TERMIOS2.size)
        fcntl.ioctl(self._master, _TCGETS2, raw, True)
        return int(_TERMIOS2.unpack(raw)[-1])

    def next_event(self) -> float:
        """Return the time [s] at which :meth:`service` is needed next without new bytes."""
        servos = self.bus.next_event()
        return min(servos, self._due[0][0] - self._spin) if self._due else servos

    @property
    def answering_until(self) -> float:
        """Arrival time [s] of the last reply, except replies delayed by a fault."""
        return self._arrives

    def driven(self) -> bool:
        """Return True if torque is on and a process, like the daemon, has locked the port."""
        if not (self.plugged and any(servo.torque_on for servo in self.bus.servos)):
            return False
        try:
            fcntl.flock(self._slave, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._slave, fcntl.LOCK_UN)
        return False

    def service(self, t: float) -> None:
        """Read bytes at time t [s], advance the servos, and send the replies that are due."""
        if self.plugged:
            for _ in range(_READS_PER_TURN):
                try:
                    data = os.read(self._master, _READ_SIZE)
                except OSError:  # no data
                    break
                if self._receive(data, t):
                    break  # the client needs some time to read the reply
                # The next request often arrives while a write is being processed.
                t = max(t, self._clock())
        self.bus.advance(t)
        self._send()

    def _receive(self, data: bytes, t: float) -> bool:
        """Pass ``data`` to the servos; return True if there is a reply."""
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
        free_at = max(self._free_at, t - PASSAGE_TIME) + len(data) * byte_time
        replies = self.bus.exchange(data, t, baud)
        for reply in replies:
            free_at += reply.delay + len(reply.data) * byte_time
            due = free_at + reply.late
            self._queue(due - PASSAGE_TIME, reply.data)
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
                if now == before:  # the hand's time is held
                    return
            self._write(heapq.heappop(self._due)[2])

    def _write(self, data: bytes) -> None:
        # A client that never reads fills the terminal. A real wire would lose these bytes too.
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass
