"""Measure the duration of ticks back to back, in place, and with emulated servos over a pty.

Back-to-back ticks run without a pause. Each in-place tick starts after a sleep, as in a running
daemon. Both kinds of ticks are measured alternately, with the same hand and canned readings. In the
last measurement, another process emulates the servos. The emulation either runs unpaced, or
simulates the transmission times of a given baud rate. In addition, the complete simulated hand is
timed over one second of virtual time.
"""

from __future__ import annotations

import contextlib
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.connection import subscribe
from softfinger.daemon.clock import Clock, RealClock
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Frame, Goal, Reading
from softfinger.daemon.wire import schema
from softfinger.tools.benchmarks.measuring import Report, attempt, figure, timed
from softfinger.tools.benchmarks.rigs import must_hold
from softfinger.tools.processes.emulate import emulator_process

_PRIORITY = 40  # SCHED_FIFO priority
# Bits per cycle for a fast sync read of 2 × 10 bytes, its reply, and a sync write of 2 × 6 bytes.
_BITS = 10 * (16 + 36 + 28)
_FRAME_COUNT = 16  # number of frames that are stored for each canned sensor
_IN_TURN = 20  # number of cycles before switching between ticks and exchanges


def measure(brief: bool = False) -> list[Report]:
    """Return tick times [µs] with a held object, and the run time per virtual second [ms]."""
    rounds, turns = (10, 10) if brief else (40, 60)
    parts: dict[str, Callable[[str], Report]] = {
        "tick": partial(_in_turns, rounds=rounds),
        "the simulated hand": partial(_simulated, seconds=3 if brief else 20),
        "hardware in the loop, unpaced": partial(in_the_loop, turns=turns, baud=0),
        "hardware in the loop, 2 Mbaud": partial(in_the_loop, turns=turns, baud=2_000_000),
    }
    return [attempt(title, partial(part, title)) for title, part in parts.items()]


def _simulated(title: str, seconds: int) -> Report:
    """Time the complete daemon with the simulated hand, per virtual second and per tick."""
    with virtual_daemon() as daemon:
        hold(daemon)
        second = timed(partial(daemon.loop.advance, 1.0), seconds)
        rows = [
            figure("a second on virtual time", "ms", 1e-3 * np.array(second), 50.0),
            figure("a tick", "µs", ticks(daemon, 2_000)),
        ]
        must_hold(daemon.loop.state)
    return Report(title, rows)


def _in_turns(title: str, rounds: int) -> Report:
    """Time ticks back to back, with and without subscribers, and in place at three rates.

    SCHED_FIFO is used if permitted.
    """
    samples: dict[str, list[float]] = {}
    used: dict[str, float] = {}  # processor load averaged over all rounds
    with virtual_daemon() as quiet, virtual_daemon(schema.STATE, schema.TACTILE) as heard:
        for daemon in (quiet, heard):
            hold(daemon)
            can(daemon)
        turns: dict[str, Callable[[], list[float]]] = {
            "back to back": partial(ticks, quiet, 200),
            "back to back, state and frames subscribed": partial(ticks, heard, 200),
        }
        for rate in (100.0, 500.0, 1000.0):
            turns[f"in place at {rate:g} Hz"] = partial(in_place, quiet, rate)
        with RealTime(Settings.model_validate({"realtime": {"priority": _PRIORITY}})):
            for _ in range(rounds):
                for name, turn in turns.items():
                    began, before = time.perf_counter(), time.thread_time()
                    samples.setdefault(name, []).extend(turn())
                    share = (time.thread_time() - before) / (time.perf_counter() - began)
                    used[name] = used.get(name, 0.0) + share / rounds
        must_hold(quiet.loop.state)
        must_hold(heard.loop.state)
    rows = [
        figure(name, "µs", found, None if "place" in name else 20.0)
        for name, found in samples.items()
    ]
    base = rows[0]["median"]
    for row in rows:
        row["× back to back"] = row["median"] / base
        if "place" in row["name"]:
            row["of a processor"] = used[row["name"]]
    return Report(title, rows)


def ticks(daemon: Daemon, count: int) -> list[float]:
    """Return the durations [µs] of ``count`` consecutive ticks in virtual time."""
    loop, clock = daemon.loop, daemon.clock
    samples = []
    for _ in range(count):
        clock.sleep_until(clock.now() + loop.period)
        samples += timed(lambda: loop.tick(clock.now()))
    return samples


def in_place(daemon: Daemon, rate: float) -> list[float]:
    """Return the durations [µs] of the ticks in 0.15 s, each started at a real-time deadline."""
    machine = RealClock(daemon.settings.realtime.spin)
    deadline, samples = machine.now(), []
    for _ in range(round(0.15 * rate)):
        deadline += 1.0 / rate
        machine.sleep_until(deadline)
        samples += ticks(daemon, 1)
    return samples


def in_the_loop(
    title: str, turns: int, baud: int, changes: Sequence[str] = (), patience: int = 10
) -> Report:
    """While holding an object, time complete ticks and plain servo exchanges over ptys alternately.

    A ``baud`` of 0 disables pacing, and ``changes`` override the profile. Raises RigError if the
    hand does not hold the object within ``patience`` [s], or loses it, e.g. on a busy machine.
    """
    in_place: list[float] = []
    back_to_back: list[float] = []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(emulator_process("--dir", folder, "--config", "hil", "--baud", baud))
        daemon = stack.enter_context(Daemon(load(Path("hil"), folder, changes), wire=False))
        stack.enter_context(RealTime(daemon.settings))
        loop, clock, state = daemon.loop, daemon.clock, daemon.loop.state
        hold(daemon, patience)
        servos = loop.torque.servos
        assert servos is not None

        def cycle() -> None:
            servos.read(state.reading)
            servos.write(state.goal)

        deadline = clock.now()
        for _ in range(turns):
            for _ in range(_IN_TURN):
                deadline = max(deadline + loop.period, clock.now())
                clock.sleep_until(deadline)
                in_place += timed(lambda: loop.tick(clock.now()))
            back_to_back += timed(cycle, _IN_TURN)
        must_hold(daemon.loop.state)
        loop.command({"command": "stop"})
        loop.tick(clock.now())
    base = float(np.median(back_to_back))
    rows = [
        figure("tick", "µs", in_place, None if baud else 1.5 * base),
        figure("read + write back to back", "µs", back_to_back, None if baud else 120.0),
    ]
    if baud:
        over = np.array(back_to_back) / (1e6 * _BITS / baud)
        rows.append(figure("read + write over its bytes' own time", "×", over, 1.15))
    return Report(title, rows)


@contextlib.contextmanager
def virtual_daemon(*topics: bytes) -> Iterator[Daemon]:
    """Yield a virtual-time daemon with private addresses, and subscribe to ``topics``."""
    with tempfile.TemporaryDirectory() as folder, zmq.Context() as context:
        sections = {
            "loop": {"clock": "virtual"},
            "stream": {"address": f"ipc://{folder}/stream"},
            "commands": {"address": f"ipc://{folder}/commands"},
        }
        settings = Settings.model_validate(sections)
        with Daemon(settings) as daemon:
            if topics:
                subscribe(context, settings.stream.address, *topics)
            try:
                yield daemon
            finally:
                context.destroy()


def hold(daemon: Daemon, patience: int = 10) -> None:
    """Grasp the simulated object with 8 N.

    Raises RigError if the object is not held within ``patience`` [s] of the machine's time, and
    Refused if a command is refused.
    """
    loop = daemon.loop
    loop.advance(0.2)
    loop.command({"command": "arm"})
    loop.advance(0.2)
    loop.command({"command": "grasp", "force": 8.0})
    for _ in range(patience):
        loop.advance(1.0)
        if loop.state.mode == "holding":
            break
    must_hold(loop.state)


class CannedServos:
    """Servo backend that repeats one reading and ignores goals."""

    def __init__(self, reading: Reading, clock: Clock) -> None:
        self._clock = clock
        self._q = reading.q.copy()
        self._current = reading.current.copy()

    def close(self) -> None:
        pass

    connect = torque_on = close

    def counters(self) -> dict[str, int]:
        return {}

    def read(self, reading: Reading) -> None:
        """Repeat the reading with a new timestamp."""
        reading.seq += 1
        reading.valid = True
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.current[:] = self._current

    def torque_off(self, reading: Reading) -> bool:
        """Confirm torque off immediately."""
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        pass


class CannedSensor(GivenFrames):
    """Sensor backend that returns a few stored frames in random order, one every ``period`` s."""

    def __init__(self, counts: list[NDArray[np.uint16]], period: float, clock: Clock) -> None:
        super().__init__()
        self._counts = counts
        self._period = period
        self._clock = clock
        self._chance = random.Random(1)
        self._last = Frame(1, clock.now(), clock.now(), True, counts[0])

    def latest(self) -> Frame:
        now = self._clock.now()
        if now - self._last.t_arrival >= self._period:
            seq = self._last.seq + 1
            self._last = Frame(seq, now, now, True, self._chance.choice(self._counts))
        return self._last


def can(daemon: Daemon) -> None:
    """Replace a daemon's backends with canned backends, so that only the tick itself is timed.

    The canned backends repeat the last reading and the next few frames. Several frames are used,
    because the daemon would diagnose a repeated frame as a frozen sensor.
    """
    loop, period = daemon.loop, 1.0 / daemon.settings.tactile.rate
    fingers = loop.perception.fingers
    grids: list[list[NDArray[np.uint16]]] = [[] for _ in fingers]
    for _ in range(_FRAME_COUNT):
        loop.advance(period)
        for kept, finger in zip(grids, fingers, strict=True):
            assert finger.frame is not None
            kept.append(finger.frame.data)
    for kept, finger in zip(grids, fingers, strict=True):
        finger.sensor = CannedSensor(kept, period, daemon.clock)
    if loop.torque.servos is not None:
        loop.torque.servos = CannedServos(loop.state.reading, daemon.clock)
