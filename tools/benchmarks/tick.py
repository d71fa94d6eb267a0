"""The tick without serial: the pipeline alone on canned readings, and with the simulated hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zmq

from daemon.assembly import Daemon
from daemon.clock import Clock
from daemon.loop import Loop
from daemon.records import Frame, Goal, Reading
from daemon.settings import Settings
from tools.benchmarks.report import Row, row

_TICKS = 20_000
_SECONDS = 20  # of virtual time
_GRIP = 8.0  # N


def measure() -> list[Row]:
    """Ticks of a hand that holds an object, in µs."""
    rows = [_virtual_second()]
    for subscribed in (False, True):
        words = "state and frames subscribed" if subscribed else "nobody subscribed"
        for canned in (True, False):
            plant = "pipeline alone" if canned else "with the simulated hand's physics"
            with _holding(subscribed) as daemon:
                samples = _run(_can(daemon) if canned else daemon.loop, daemon)
            aim = 20.0 if canned else None
            rows.append(row(f"tick, {plant}, {words}", "µs", samples, aim))
    return rows


def _virtual_second() -> Row:
    """The whole daemon on virtual time: physics, rendered frames, estimator, control."""
    with _holding(subscribed=False) as daemon:
        samples = []
        for _ in range(_SECONDS):
            before = time.perf_counter()
            daemon.loop.advance(1.0)
            samples.append((time.perf_counter() - before) * 1e3)
    return row("one second of the whole daemon on virtual time", "ms", samples, aim=50.0)


@contextmanager
def _holding(subscribed: bool) -> Iterator[Daemon]:
    """A daemon on virtual time that has grasped the simulated object."""
    settings = Settings.model_validate(
        {
            "loop": {"clock": "virtual"},
            "stream": {"address": "tcp://127.0.0.1:19872"},
            "commands": {"address": "tcp://127.0.0.1:19873"},
        }
    )
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.SUB)
    with Daemon(settings) as daemon:
        if subscribed:
            socket.setsockopt(zmq.SUBSCRIBE, b"hand")
            socket.connect(settings.stream.address)
        loop = daemon.loop
        loop.advance(0.2)
        loop.command({"command": "arm"})
        loop.advance(0.2)
        loop.command({"command": "grasp", "force": _GRIP})
        loop.advance(3.0)
        if loop.state.mode != "holding":
            raise RuntimeError(f"the hand did not hold: {loop.state.mode} {loop.state.fault}")
        yield daemon
    socket.close(linger=0)
    context.term()


def _run(loop: Loop, daemon: Daemon) -> list[float]:
    clock = daemon.clock
    samples = []
    for _ in range(_TICKS):
        clock.sleep_until(clock.now() + loop.period)
        before = time.perf_counter_ns()
        loop.tick(clock.now())
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    return samples


class _CannedServos:
    """Always the same good reading; goals go nowhere."""

    def __init__(self, reading: Reading, clock: Clock) -> None:
        self._clock = clock
        self._q = reading.q.copy()
        self._current = reading.current.copy()

    def connect(self) -> None: ...

    def read(self, reading: Reading) -> None:
        reading.seq += 1
        reading.valid = True
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.current[:] = self._current

    def set_torque(self, on: bool) -> None: ...

    def write(self, goal: Goal) -> None: ...

    def counters(self) -> dict[str, int]:
        return {}

    def close(self) -> None: ...


class _CannedSensor:
    """The same counts again and again, a new frame at the sensor's rate."""

    def __init__(self, counts: np.ndarray[Any, np.dtype[np.uint16]], period: float, clock: Clock):
        self._counts = counts
        self._period = period
        self._clock = clock
        self._frame = Frame(1, clock.now(), clock.now(), True, counts)

    def open(self) -> None: ...

    def latest(self) -> Frame:
        now = self._clock.now()
        if now - self._frame.t_arrival >= self._period:
            self._frame = Frame(self._frame.seq + 1, now, now, True, self._counts)
        return self._frame

    def counters(self) -> dict[str, int]:
        return {}

    def close(self) -> None: ...


def _can(daemon: Daemon) -> Loop:
    """Put canned backends in place of the simulated ones, with what those last said."""
    loop = daemon.loop
    for perception in loop.perceptions:
        assert perception.frame is not None
        period = 1.0 / daemon.settings.tactile.rate
        perception.sensor = _CannedSensor(perception.frame.data, period, daemon.clock)
    loop.servos = _CannedServos(loop.state.reading, daemon.clock)
    return loop
