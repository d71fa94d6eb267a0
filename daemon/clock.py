"""Provide the clocks of the pipeline: real, simulated and virtual time.

The pipeline reads time only from its clock, never from the system.
"""

from __future__ import annotations

import mmap
import os
import time
from pathlib import Path
from typing import Protocol

from softfinger.daemon.backends import backend
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS


class Clock(Protocol):
    """Time for the pipeline, in seconds."""

    pauses_when_late: bool  # the hand's time pauses while this machine is late

    def now(self) -> float:
        """Return the monotonic time [s]."""

    def wall(self) -> float:
        """Return the Unix time [s] that corresponds to `now`."""

    def sleep_until(self, t: float) -> float:
        """Sleep until monotonic time ``t``; return the lateness of the wake-up [s].

        Return at once if ``t`` has passed.
        """


class LoopClock(Clock, Protocol):
    """Clock of the loop, which also measures the machine's own time."""

    behind: float  # s by which `now` lags the machine since the clock was created

    def host(self) -> float:
        """Return the machine's monotonic time [s], which measures work and lateness."""


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
    """Return True if all ports belong to a running `softfinger emulate`."""
    ports = []
    if backend("servos", settings.servos.backend).metal:
        ports.append(settings.servos.port)
    if backend("tactile", settings.tactile.backend).metal:
        ports += [settings.tactile.port[FINGERS.index(name)] for name in settings.scene.fingers]
    # The emulator's port links and its control socket are in one folder.
    return bool(ports) and all(Path(port).with_name("control").is_socket() for port in ports)


class Deadline:
    """Time of a daemon's next tick [s], beyond which an emulated hand does not advance.

    The value, by the daemon's clock, is in a file beside the emulator's ports, which both processes
    map into memory.
    """

    NAME = ".deadline"

    def __init__(self, path: Path, create: int = 0) -> None:
        """Map ``path``; ``create`` is `os.O_CREAT` or 0. Raises OSError."""
        file = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | create, 0o600)
        try:
            os.ftruncate(file, 8)
            self._value = memoryview(mmap.mmap(file, 8)).cast("d")
        finally:
            os.close(file)

    @classmethod
    def of(cls, port: str) -> Deadline | None:
        """Return the deadline of the emulator that owns ``port``, or None without one."""
        try:
            return cls(Path(port).with_name(cls.NAME))
        except OSError:
            return None

    @property
    def t(self) -> float:
        """Time that was set last [s], initially 0."""
        return self._value[0]

    @t.setter
    def t(self, t: float) -> None:
        self._value[0] = t


class RealClock:
    """The machine's monotonic clock.

    The last ``spin`` s of a sleep are a busy wait, which hides the system's wake-up latency of tens
    of microseconds. That processor time is not available to other threads.
    """

    now = staticmethod(time.monotonic)
    host = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
    behind = 0.0
    pauses_when_late = False

    def __init__(self, spin: float = 0.0) -> None:
        self._spin = spin

    def sleep_until(self, t: float) -> float:
        """Sleep until ``t``; a signal handler may run meanwhile without ending the sleep."""
        now = time.monotonic
        delay = t - self._spin - now()
        if delay > 0.0:
            time.sleep(delay)
        while (woke := now()) < t:
            pass
        return woke - t


class HandClock:
    """Clock of a simulated or emulated hand, which waits for a late machine.

    The time is constant between two sleeps, and each sleep ends exactly at its deadline, however
    late the machine wakes up. Lateness shorter than the time to the next deadline is caught up. Any
    further lateness does not exist for the hand and is added to ``behind``. An emulated hand reads
    from ``due`` how far its time may advance.
    """

    pauses_when_late = True

    def __init__(self, machine: LoopClock, due: Deadline | None = None) -> None:
        self._machine = machine
        self._due = due
        self._now = machine.now()
        self.behind = 0.0

    def now(self) -> float:
        """Return the hand's time [s]: the deadline of the last sleep."""
        return self._now

    def wall(self) -> float:
        """Return the machine's Unix time [s]."""
        return self._machine.wall()

    def host(self) -> float:
        """Return the machine's monotonic time [s]."""
        return self._machine.host()

    def sleep_until(self, t: float) -> float:
        """Sleep until the hand's time is ``t``; if that is past, add the delay to ``behind``."""
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
    """Clock that advances only when the loop sleeps, as fast as the machine allows.

    All its times start at ``start``, so two runs with the same seed are identical.
    """

    behind = 0.0
    pauses_when_late = True

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now

    wall = now
    host = now  # computation takes no virtual time

    def sleep_until(self, t: float) -> float:
        """Advance the time to ``t`` unless it has passed; return 0, as it is never late."""
        if t > self._now:
            self._now = t
        return 0.0
