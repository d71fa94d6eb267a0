"""Whose time the hand lives in. The pipeline asks its clock and never the system itself."""

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

    waits: bool  # the hand's time stands still while this machine is late

    def now(self) -> float:
        """Monotonic time [s]."""

    def wall(self) -> float:
        """Unix time [s] that belongs to now."""

    def sleep_until(self, t: float) -> float:
        """Return at monotonic time ``t``, at once if that has passed: how late it woke up [s]."""


class LoopClock(Clock, Protocol):
    """Clock of the loop, which also tells the machine's own time that things take."""

    behind: float  # s that `now` has been kept back since the clock was made

    def host(self) -> float:
        """The machine's monotonic time [s], by which work and lateness are measured."""


def make_clock(settings: Settings) -> LoopClock:
    """The clock that ``loop.clock`` names."""
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
    """Return whether all ports are those of a `softfinger emulate` that runs."""
    ports = []
    if backend("servos", settings.servos.backend).metal:
        ports.append(settings.servos.port)
    if backend("tactile", settings.tactile.backend).metal:
        ports += [settings.tactile.port[FINGERS.index(name)] for name in settings.scene.fingers]
    # Its links and its control socket share a folder.
    return bool(ports) and all(Path(port).with_name("control").is_socket() for port in ports)


class Deadline:
    """Time of a daemon's next tick [s, by its clock], for the emulated hand to go no further.

    It is in a file beside the emulator's ports that both have mapped.
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
        """Return that of the emulator whose ``port`` this is; None where there is none."""
        try:
            return cls(Path(port).with_name(cls.NAME))
        except OSError:
            return None

    @property
    def t(self) -> float:
        """The time that was set last [s]; 0 before."""
        return self._value[0]

    @t.setter
    def t(self, t: float) -> None:
        self._value[0] = t


class RealClock:
    """The machine's monotonic clock.

    The last ``spin`` s before the end of a sleep are waited awake: the system's own wake-up takes
    tens of microseconds, which the spin covers. That time is lost to others on the processor.
    """

    now = staticmethod(time.monotonic)
    host = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
    behind = 0.0
    waits = False

    def __init__(self, spin: float = 0.0) -> None:
        self._spin = spin

    def sleep_until(self, t: float) -> float:
        """Sleep; a signal handler may run meanwhile, and the sleep goes on after it."""
        now = time.monotonic
        delay = t - self._spin - now()
        if delay > 0.0:
            time.sleep(delay)
        while (woke := now()) < t:
            pass
        return woke - t


class HandClock:
    """Time of a simulated or emulated hand: the machine's, but it waits for it.

    Time stands between two sleeps, and a sleep ends at its deadline to the bit however late the
    machine wakes up. What that takes from the time to the next deadline is made up for; what goes
    beyond never happens for the hand, and adds to ``behind``. An emulated hand learns by ``due``
    how far its time may go.
    """

    waits = True

    def __init__(self, machine: LoopClock, due: Deadline | None = None) -> None:
        self._machine = machine
        self._due = due
        self._now = machine.now()
        self.behind = 0.0

    def now(self) -> float:
        """The hand's time [s]: the machine's less ``behind`` when the last sleep was to end."""
        return self._now

    def wall(self) -> float:
        """The machine's Unix time [s]."""
        return self._machine.wall()

    def host(self) -> float:
        """The machine's monotonic time [s]."""
        return self._machine.host()

    def sleep_until(self, t: float) -> float:
        """Sleep until the machine has come to ``t``; a deadline that it has missed is now."""
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
    """Time that moves only when the loop waits for it, as fast as the machine can.

    All its times start at ``start``, so that two runs with one seed are the same to the bit.
    """

    behind = 0.0
    waits = True

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Virtual time [s]."""
        return self._now

    wall = now  # its epoch is 1970
    host = now  # whatever is done takes no time

    def sleep_until(self, t: float) -> float:
        """Move time to ``t`` unless it is there already; never late."""
        if t > self._now:
            self._now = t
        return 0.0
