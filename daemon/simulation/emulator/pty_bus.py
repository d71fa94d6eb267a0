"""Provide an emulated servo bus on a pseudo-terminal.

This module manages the terminal and simulates the transmission times. A paced bus sends each reply
when a real bus would deliver the reply's last byte. The delivery time includes the return delay and
the transmission time at the client's baud rate. An unpaced bus replies immediately. Delivery times
are absolute, so delays of this process do not add up.
"""

from __future__ import annotations

import fcntl
import heapq
import math
import os
import pty
import struct
import tty
from collections.abc import Callable

from softfinger.daemon.simulation.faults import WELL
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus

_TCGETS2 = 0x802C542A  # termios2 fields: four flag words, line, 19 control characters, two speeds
_TERMIOS2 = struct.Struct("=4IB19s2I")
_BITS_PER_BYTE = 10  # one start bit, eight data bits and one stop bit
_READ_SIZE = 4096
_READS_PER_TURN = 4  # maximum number of reads per service call, to leave time for other tasks
# Duration of silence that ends a packet [s]. The parser's default of 1.5 ms would be too short
# because this process may be delayed.
_GAP_TIME = 0.02
# Typical latency from a write to a pseudo-terminal until the reader wakes up [s]. A paced bus
# simulates transmission times, so it subtracts this latency in both directions.
PASSAGE_TIME = 15e-6
# Maximum age of a reading at the time of the reply [s]. An age above 0 allows the emulator to
# compute the physics between exchanges. Real servos also measure at their own intervals.
_LAG_TIME = 0.0005


class PtyPort:
    """Pseudo-terminal at ``path``, which can be unplugged and plugged in again.

    The slave stays open in this process, so clients can connect and disconnect without errors.
    """

    def __init__(self) -> None:
        self.plug()

    def fileno(self) -> int:
        """Return the file descriptor to wait for, or -1 while the port is unplugged."""
        return self._master

    @property
    def plugged(self) -> bool:
        """True while the terminal exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Create or recreate the terminal at a new ``path``."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def unplug(self) -> None:
        """Remove the terminal, which makes a client's reads fail, but keep the device running."""
        if self.plugged:
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    def apply_fault(self, kind: str, value: float, t: float) -> None:
        """Begin a fault of the port or device; the kinds ``plug`` and ``well`` end faults."""
        if kind == "unplug":
            self.unplug()
        elif kind in ("plug", WELL) and not self.plugged:
            self.plug()


class PtyServoBus(PtyPort):
    """Servo bus on a new pseudo-terminal.

    The caller must call :meth:`service` when :meth:`fileno` is readable, and at the time that
    :meth:`next_event` returns. If ``baud`` is 0, servos reply immediately at any rate. Otherwise,
    servos ignore clients that use another rate, and replies are delayed by their transmission time.
    Because sleeps end late, the last ``spin`` [s] before a reply are a busy wait.
    """

    def __init__(
        self,
        bus: ServoBus,
        *,
        baud: int,
        clock: Callable[[], float],
        spin: float = 0.00012,
    ) -> None:
        self.bus = bus
        bus.parser.gap = _GAP_TIME
        bus.lag = _LAG_TIME
        self._baud = baud
        self._spin = spin
        self._clock = clock
        self._free_at = -math.inf  # time at which the wire becomes free
        self._due: list[tuple[float, int, bytes]] = []
        self._order = 0
        self.answering_until = -math.inf  # arrival time of the last reply without a fault's delay
        super().__init__()

    def unplug(self) -> None:
        """Remove the terminal, as if an adapter were unplugged, but keep the servos running."""
        self._due.clear()
        self.bus.parser.reset()
        super().unplug()

    def apply_fault(self, kind: str, value: float, t: float) -> None:
        """Begin a fault of the port, line or servos; the kinds ``plug`` and ``well`` end faults."""
        super().apply_fault(kind, value, t)
        if kind == WELL:
            self.bus.recover(t)
        else:
            self.bus.fault(kind, value, t)

    def client_baud(self) -> int:
        """Return the terminal's baud rate."""
        raw = bytearray(_TERMIOS2.size)
        fcntl.ioctl(self._master, _TCGETS2, raw, True)
        return int(_TERMIOS2.unpack(raw)[-1])

    def next_event(self) -> float:
        """Return the latest time [s] at which :meth:`service` must be called."""
        servos = self.bus.due
        return min(servos, self._due[0][0] - self._spin) if self._due else servos

    def driven(self) -> bool:
        """Return True if torque is on and a process such as the daemon has locked the port."""
        if not (self.plugged and any(servo.torque_on for servo in self.bus.servos)):
            return False
        try:
            fcntl.flock(self._slave, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._slave, fcntl.LOCK_UN)
        return False

    def service(self, t: float) -> None:
        """Read bytes at time t [s], advance the servos, and send due replies."""
        if self.plugged:
            for _ in range(_READS_PER_TURN):
                try:
                    data = os.read(self._master, _READ_SIZE)
                except OSError:  # No data are available.
                    break
                if self._receive(data, t):
                    break  # The client needs time to read the reply.
                # The next request often arrives while the servos process a write.
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
                self.answering_until = due
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
                if now == before:  # The hand's clock is paused.
                    return
            self._write(heapq.heappop(self._due)[2])

    def _write(self, data: bytes) -> None:
        # If a client never reads, the terminal buffer fills up. A real line would also lose the
        # excess bytes.
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass
