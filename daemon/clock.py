"""Provide the pipeline's clocks for real, simulated and virtual time.

The pipeline reads the time only from its clock, never directly from the system.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import time
from pathlib import Path
from typing import Protocol

from softfinger.daemon.profile.settings import Settings


class Clock(Protocol):
    """Time source of the pipeline; all times are in seconds."""

    pauses_when_late: bool  # True if the hand's clock pauses while this machine is late

    def now(self) -> float:
        """Return the monotonic time [s]."""

    def wall(self) -> float:
        """Return the Unix time [s] that corresponds to `now`."""

    def sleep_until(self, t: float) -> float:
        """Sleep until monotonic time ``t`` and return the wake-up delay [s].

        Return immediately if ``t`` has passed.
        """


class LoopClock(Clock, Protocol):
    """Clock that drives the loop and also provides the machine's real time."""

    behind: float  # total time by which `now` lags behind the machine's clock [s]

    def host(self) -> float:
        """Return the machine's monotonic time [s] for measuring computation times and delays."""


def make_clock(settings: Settings) -> LoopClock:
    """Return the clock selected by ``loop.clock``."""
    name = settings.loop.clock
    if name == "auto":
        name = "hand" if settings.simulated or emulated(settings) else "real"
    if name == "virtual":
        return VirtualClock()
    real = RealClock(settings.realtime.spin)
    if name != "hand":
        return real
    return HandClock(real, None if settings.simulated else Deadline.of(settings.servos.port))


def emulated(settings: Settings) -> bool:
    """Return True if all ports belong to a running ``softfinger emulate`` process."""
    ports = settings.ports()
    # The emulator creates its port links and its control socket in the same folder.
    return bool(ports) and all(Path(port).with_name("control").is_socket() for _, port in ports)


class Deadline:
    """Start time [s] of the daemon's next tick; an emulated hand must not advance past this time.

    The daemon's clock measures the time. The time is stored in a file in the emulator's port
    folder. The daemon and the emulator map the file into memory.
    """

    NAME = ".deadline"

    def __init__(self, path: Path, create: int = 0) -> None:
        """Map the file at ``path``; ``create`` is `os.O_CREAT` or 0. Raises OSError."""
        self._path = path
        self._map(create)

    def _map(self, create: int) -> None:
        file = os.open(self._path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | create, 0o600)
        try:
            os.posix_fallocate(file, 0, 8)  # On a full disk, writing to a hole raises SIGBUS.
            self._value = memoryview(mmap.mmap(file, 8)).cast("d")
            self._inode = os.fstat(file).st_ino
        finally:
            os.close(file)

    @classmethod
    def of(cls, port: str) -> Deadline | None:
        """Return the deadline of the emulator that owns ``port``, or None for a real port."""
        try:
            return cls(Path(port).with_name(cls.NAME))
        except OSError:
            return None

    @property
    def t(self) -> float:
        """Most recent deadline [s], initially 0."""
        return self._value[0]

    @t.setter
    def t(self, t: float) -> None:
        with contextlib.suppress(OSError):  # The emulator has exited.
            if self._path.stat().st_ino != self._inode:
                self._map(0)  # A restarted emulator has created a new file.
        self._value[0] = t


class RealClock:
    """The machine's monotonic clock.

    Each sleep ends with a busy wait of ``spin`` [s]. The busy wait hides the system's wake-up
    latency of tens of microseconds. During the busy wait, the processor is not available to other
    threads.
    """

    now = staticmethod(time.monotonic)
    host = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
    behind = 0.0
    pauses_when_late = False

    def __init__(self, spin: float = 0.0) -> None:
        self._spin = spin

    def sleep_until(self, t: float) -> float:
        """Sleep until ``t``; continue the sleep if a signal handler interrupts it."""
        now = time.monotonic
        delay = t - self._spin - now()
        if delay > 0.0:
            time.sleep(delay)
        while (woke := now()) < t:
            pass
        return woke - t


class HandClock:
    """Clock of a simulated or emulated hand; the clock pauses while the machine is late.

    The clock's time changes only during a sleep. After a sleep, the time equals the sleep's
    deadline, even if the machine woke up late. If a delay is shorter than the time to the next
    deadline, the next sleep is shorter. If the delay is longer, the excess is added to ``behind``
    and does not affect the hand's time. An emulated hand must not advance past ``due``.
    """

    pauses_when_late = True

    def __init__(self, machine: LoopClock, due: Deadline | None = None) -> None:
        self._machine = machine
        self.wall = machine.wall
        self.host = machine.host
        self._due = due
        self._now = machine.now()
        self.behind = 0.0

    def now(self) -> float:
        """Return the hand's time [s], which is the deadline of the last sleep."""
        return self._now

    def sleep_until(self, t: float) -> float:
        """Sleep until the hand's time is ``t``; add any delay of the machine to ``behind``."""
        self._now = max(t, self._now)
        if self._due is not None:
            self._due.t = self._now
        due = self._now + self.behind
        missed = self._machine.now() - due
        if missed <= 0.0:
            return self._machine.sleep_until(due)
        self.behind += missed
        return 0.0


class VirtualClock:
    """Clock that advances only when the loop sleeps, so the loop runs at full speed.

    The clock begins at ``start``, so two runs with the same seed are identical.
    """

    behind = 0.0
    pauses_when_late = True

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now

    wall = now
    host = now  # Computations take no virtual time.

    def sleep_until(self, t: float) -> float:
        """Advance the clock to ``t`` unless ``t`` has passed; return a wake-up delay of 0."""
        if t > self._now:
            self._now = t
        return 0.0
