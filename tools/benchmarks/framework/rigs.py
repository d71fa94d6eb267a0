"""What several benchmarks run on: processes of softfinger, daemons that hold, canned backends."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, Goal, Reading

Sections = Mapping[str, Mapping[str, Any]]

HIL = Path(__file__).parents[3] / "config" / "hil.toml"
_KEPT = 16  # frames that take turns


@contextlib.contextmanager
def emulator(folder: Path, config: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """The simulated hand behind ptys in ``folder``, in a process of its own, once it answers."""
    command = [sys.executable, "-m", "softfinger", "emulate", "--dir", str(folder)]
    process = subprocess.Popen(
        [*command, "--config", str(config), *words], stdout=subprocess.PIPE, text=True
    )
    with process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("the emulated hand did not start")
            yield process
        finally:
            process.terminate()


@contextlib.contextmanager
def virtual_daemon(sections: Sections, *topics: str | bytes) -> Iterator[Daemon]:
    """A daemon on virtual time with its own addresses, ``topics`` of which are subscribed to."""
    with tempfile.TemporaryDirectory() as folder, zmq.Context() as context:
        base = {
            "loop": {"clock": "virtual"},
            "stream": {"address": f"ipc://{folder}/stream"},
            "commands": {"address": f"ipc://{folder}/commands"},
        }
        merged = {
            name: {**base.get(name, {}), **sections.get(name, {})} for name in {**base, **sections}
        }
        settings = Settings.model_validate(merged)
        with Daemon(settings) as daemon, context.socket(zmq.SUB) as socket:
            for topic in topics:
                socket.subscribe(topic)
            socket.connect(settings.stream.address)
            yield daemon


def hold(daemon: Daemon, force: float = 8.0) -> None:
    """Grasp the simulated object. Raises RuntimeError when it is not held within 3 s."""
    loop = daemon.loop
    loop.advance(0.2)
    loop.command({"command": "arm"})
    loop.advance(0.2)
    loop.command({"command": "grasp", "force": force})
    loop.advance(3.0)
    if loop.state.mode != "holding":
        raise RuntimeError(f"the hand did not hold: {loop.state.mode} {loop.state.fault}")


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
        """Confirmed at once."""
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
    """The same few grids of counts again and again, each a new frame, every ``period`` s."""

    def __init__(self, counts: list[NDArray[np.uint16]], period: float, clock: Clock) -> None:
        self._counts = counts
        self._period = period
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


def can(daemon: Daemon, every_tick: bool = False) -> None:
    """Put canned backends in place of a daemon's, so that a tick costs what it does by itself.

    They repeat the next frames and the last reading: one frame alone would be a frozen sensor.
    Frames are new at the settings' rate, or at every tick.
    """
    loop, period = daemon.loop, 1.0 / daemon.settings.tactile.rate
    fingers = loop.perception.fingers
    grids: list[list[NDArray[np.uint16]]] = [[] for _ in fingers]
    for _ in range(_KEPT):
        loop.advance(period)
        for kept, finger in zip(grids, fingers, strict=True):
            assert finger.frame is not None
            kept.append(finger.frame.data)
    for kept, finger in zip(grids, fingers, strict=True):
        finger.sensor = CannedSensor(kept, 0.0 if every_tick else period, daemon.clock)
    if loop.servos is not None:
        loop.servos = CannedServos(loop.state.reading, daemon.clock)
