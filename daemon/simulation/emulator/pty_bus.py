"""A servo bus behind a pseudo-terminal, to be turned over by somebody else's event loop.

It owns the terminal and the time on the wire: replies leave when their last byte would have
arrived at the client's baud rate, return delays and a USB adapter's latency included; or at once,
unpaced. Times on the wire are absolute: where this process was kept from running, which no servo
ever is, that does not count. What the bytes mean is :mod:`simulation.servo_model.servo_bus`'s
affair.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import math
import os
import pty
import struct
import time
import tty
from collections.abc import Callable
from pathlib import Path

from softfinger.daemon.simulation.emulator.run_delay import RunDelay
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus

_TCGETS2 = 0x802C542A  # struct termios2: four flag words, line, 19 control characters, two speeds
_TERMIOS2 = struct.Struct("=4IB19s2I")
_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_READ_SIZE = 4096
_AT_A_TIME = 4  # reads, so that a client that never pauses leaves time for the rest of the hand
# s: about what a pseudo-terminal takes from one process's write to the other's read, woken by it.
# A paced bus takes it off both ways, since it stands for a wire that has its own time already.
PASSAGE = 15e-6


class PtyServoBus:
    """``bus`` on a new pseudo-terminal.

    The loop that owns it waits until :meth:`fileno` is readable or :meth:`next_event` has come,
    then calls :meth:`service`; ``clock`` must be the clock that those times are of.

    Args:
        link: where to put a symbolic link to the terminal; a link that is there is replaced.
        baud: 0 answers at any rate and at once. Above 0 a servo is deaf to a client whose port is
            set to another rate than its own, and replies take their time on the wire.
        latency: s, a USB adapter's latency timer: replies come at multiples of it.
        spin: s before a paced reply is due in which :meth:`service` waits for it awake, since a
            sleep ends late by a timer's slack.
    """

    def __init__(
        self,
        bus: ServoBus,
        link: Path | None = None,
        *,
        baud: int = 0,
        latency: float = 0.0,
        spin: float = 0.00012,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.bus = bus
        # A reader may be held up within a packet for longer than a wire would be silent.
        bus.parser.gap = max(bus.parser.gap, 0.02)
        self.link = link
        self._baud = baud
        self._latency = latency
        self._spin = spin
        self._clock = clock
        self._run_delay: RunDelay | None = None
        self._master = self._slave = -1
        self._free_at = -math.inf  # the wire is busy until then
        self._due: list[tuple[float, int, bytes]] = []
        self._order = 0
        self.plug()

    @property
    def path(self) -> str:
        """What a client opens: the link, or the terminal itself."""
        return str(self.link) if self.link is not None else self._name

    def fileno(self) -> int:
        """The descriptor to wait for; -1 while unplugged."""
        return self._master

    def plug(self) -> None:
        """Make the terminal (again) and link it."""
        self._master, self._slave = pty.openpty()
        # The slave stays open here and raw, so that a client may come and go without an error.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self.link is not None:
            fresh = self.link.with_name(f".{self.link.name}.{os.getpid()}")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self._name)
            fresh.replace(self.link)

    def unplug(self) -> None:
        """Take the whole port away, as when an adapter is pulled; the servos go on."""
        self._due.clear()
        self.bus.parser.reset()
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1
        if self.link is not None and self.link.is_symlink():
            with contextlib.suppress(OSError):
                if self.link.readlink() == Path(self._name):
                    self.link.unlink()

    def close(self) -> None:
        """Take the port away for good."""
        self.unplug()
        if self._run_delay is not None:
            self._run_delay.close()

    def client_baud(self) -> int:
        """The rate that the terminal is set to."""
        raw = bytearray(_TERMIOS2.size)
        fcntl.ioctl(self._master, _TCGETS2, raw, True)
        return int(_TERMIOS2.unpack(raw)[-1])

    def next_event(self) -> float:
        """When :meth:`service` is needed next [s] though no byte came."""
        servos = self.bus.next_event()
        return min(servos, self._due[0][0] - self._spin) if self._due else servos

    def service(self, t: float, since: float | None = None) -> None:
        """Take what has arrived by time t [s], let the servos act, send what is due.

        ``since``: when the caller began to wait, as it had nothing to take; now, if it is not told.
        """
        if self._master < 0:
            self.bus.advance(t)
            return
        arrived = self._arrival(t, t if since is None else since) if self._baud else t
        for _ in range(_AT_A_TIME):
            try:
                data = os.read(self._master, _READ_SIZE)
            except OSError:  # nothing there
                break
            self._receive(data, t, arrived)
            # A client's next request often comes while its last write is being done.
            arrived = t = max(t, self._clock())
        if t > self.bus.now:
            self.bus.advance(t)
        self._send()

    def _arrival(self, t: float, since: float) -> float:
        """When bytes seen at time t came, if others had the processor from then on."""
        if self._run_delay is None:
            self._run_delay = RunDelay()
        return min(t, max(since, t - self._run_delay.since_last()))

    def _receive(self, data: bytes, t: float, arrived: float) -> None:
        if not self._baud:
            for reply in self.bus.exchange(data, t):
                if reply.late:
                    self._queue(t + reply.late, reply.data)
                else:
                    self._write(reply.data)
            return
        baud = self.client_baud()
        if baud <= 0:
            return
        byte_time = _BITS_PER_BYTE / baud
        free_at = max(self._free_at, arrived - PASSAGE) + len(data) * byte_time
        for reply in self.bus.exchange(data, t, baud):
            free_at += reply.delay + len(reply.data) * byte_time
            due = free_at + reply.late
            if self._latency > 0.0:
                due = math.ceil(due / self._latency) * self._latency
            self._queue(due - PASSAGE, reply.data)
        self._free_at = free_at

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
                now = self._clock()
            self._write(heapq.heappop(self._due)[2])

    def _write(self, data: bytes) -> None:
        # A client that never reads fills the terminal; a wire would lose those bytes too.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)
