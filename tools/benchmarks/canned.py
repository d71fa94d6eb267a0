"""Backends that always say the same, so that a tick's own cost is measured and no simulation's."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.types import Frame, Goal, Reading

_KEPT = 16  # frames that take turns


class CannedServos:
    """Always the same good reading; goals go nowhere."""

    def __init__(self, reading: Reading, clock: Clock) -> None:
        self._clock = clock
        self._q = reading.q.copy()
        self._current = reading.current.copy()

    def connect(self) -> None:
        """Nothing to do."""

    def read(self, reading: Reading) -> None:
        """The same again, taken now."""
        reading.seq += 1
        reading.valid = True
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.current[:] = self._current

    def torque_on(self) -> None:
        """Nothing to do."""

    def torque_off(self, reading: Reading) -> bool:
        """Off it is."""
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        """Nothing to do."""

    def counters(self) -> dict[str, int]:
        """None."""
        return {}

    def close(self) -> None:
        """Nothing to do."""


class CannedSensor:
    """The same few grids of counts again and again, each a new frame, at a rate [Hz].

    A rate of infinity gives a new frame each time it is asked for one.
    """

    def __init__(self, counts: list[NDArray[np.uint16]], rate: float, clock: Clock) -> None:
        self._counts = counts
        self._period = 1.0 / rate
        self._clock = clock
        self._frame = Frame(1, clock.now(), clock.now(), True, counts[0])

    def open(self) -> None:
        """Nothing to do."""

    def latest(self) -> Frame:
        """The newest frame."""
        now = self._clock.now()
        if now - self._frame.t_arrival >= self._period:
            seq = self._frame.seq + 1
            self._frame = Frame(seq, now, now, True, self._counts[seq % len(self._counts)])
        return self._frame

    def counters(self) -> dict[str, int]:
        """None."""
        return {}

    def close(self) -> None:
        """Nothing to do."""


def can(daemon: Daemon, rate: float = 0.0) -> None:
    """Put canned backends in place of a daemon's, with what those say in the next moments.

    The same frame again and again would be a frozen sensor, which is a fault. Frames come at
    ``rate`` [Hz], 0 for the settings'.
    """
    loop = daemon.loop
    grids: list[list[NDArray[np.uint16]]] = [[] for _ in loop.perception.fingers]
    for _ in range(_KEPT):
        loop.advance(1.0 / daemon.settings.tactile.rate)
        for kept, perception in zip(grids, loop.perception.fingers, strict=True):
            assert perception.frame is not None
            kept.append(perception.frame.data)
    for kept, perception in zip(grids, loop.perception.fingers, strict=True):
        perception.sensor = CannedSensor(kept, rate or daemon.settings.tactile.rate, daemon.clock)
    if loop.servos is not None:
        loop.servos = CannedServos(loop.state.reading, daemon.clock)


def make_noisy(daemon: Daemon, rate: float) -> None:
    """Sensors that send nothing but noise, over the whole of their range, at ``rate`` [Hz]."""
    generator = np.random.default_rng(1)
    settings = daemon.settings.tactile
    shape = (settings.rows, settings.cols)
    for perception in daemon.loop.perception.fingers:
        grids = [
            generator.integers(0, min(settings.full_count, 60_000), shape, dtype=np.uint16)
            for _ in range(_KEPT)
        ]
        perception.sensor = CannedSensor(grids, rate, daemon.clock)


def hold(daemon: Daemon, force: float = 8.0) -> None:
    """Grasp the simulated object. Raises RuntimeError when it is not held within 3 s."""
    loop = daemon.loop
    requests: list[tuple[float, dict[str, Any]]] = [
        (0.2, {"command": "arm"}),
        (0.2, {"command": "grasp", "force": force}),
    ]
    for wait, request in requests:
        loop.advance(wait)
        loop.command(request)
    loop.advance(3.0)
    if loop.state.mode != "holding":
        raise RuntimeError(f"the hand did not hold: {loop.state.mode} {loop.state.fault}")
