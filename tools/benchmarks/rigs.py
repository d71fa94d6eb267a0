"""Provide daemons that hold an object, canned backends and emulated hands for benchmarks."""

from __future__ import annotations

import contextlib
import random
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.connection import subscribe
from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, Goal, Reading, State

Sections = Mapping[str, Mapping[str, Any]]

SOLID: Sections = {  # tips of solid rubber
    "tip": {"physics": "solid"},
    "material": {"law": "constant", "modulus": 0.15e6},
    "safety": {"d_max": 0.008},
}
SENSORS: dict[str, Sections] = {  # sensors with defects; the ideal sensor adds only noise
    name: load(Path(name)).model_dump(exclude_unset=True) for name in ("velostat", "capacitive")
}
_FRAME_COUNT = 16  # number of frames that are stored for each canned sensor


class RigError(SoftfingerError):
    """Error raised if a test rig fails, so that a measurement is impossible."""


def merged(sections: Sections, base: Sections) -> dict[str, dict[str, Any]]:
    """Return ``base`` updated with ``sections``."""
    return {k: {**base.get(k, {}), **sections.get(k, {})} for k in {**base, **sections}}


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


def hold(daemon: Daemon) -> None:
    """Grasp the simulated object with 8 N.

    Raises RigError if the object is not held within 10 s, and Refused if a command is refused.
    """
    loop = daemon.loop
    loop.advance(0.2)
    loop.command({"command": "arm"})
    loop.advance(0.2)
    loop.command({"command": "grasp", "force": 8.0})
    for _ in range(10):
        loop.advance(1.0)
        if loop.state.mode == "holding":
            break
    must_hold(loop.state)


def must_hold(state: State) -> None:
    """Raise RigError unless the hand is holding an object."""
    if state.mode != "holding":
        raise RigError(f"the hand failed to grip the object: {state.mode} {state.fault}")


class _Canned:
    """Base class for canned backends; its operations do nothing."""

    def close(self) -> None:
        """Do nothing."""

    connect = open = torque_on = close

    def counters(self) -> dict[str, int]:
        """Return an empty dictionary."""
        return {}


class CannedServos(_Canned):
    """Servo backend that repeats one reading and ignores goals."""

    def __init__(self, reading: Reading, clock: Clock) -> None:
        self._clock = clock
        self._q = reading.q.copy()
        self._current = reading.current.copy()

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
        """Ignore the goal."""


class CannedSensor(_Canned):
    """Sensor backend that returns a few stored frames in random order, one every ``period`` s."""

    def __init__(self, counts: list[NDArray[np.uint16]], period: float, clock: Clock) -> None:
        self._counts = counts
        self._period = period
        self._clock = clock
        self._chance = random.Random(1)
        self._frame = Frame(1, clock.now(), clock.now(), True, counts[0])

    def latest(self) -> Frame:
        """Return the current frame."""
        now = self._clock.now()
        if now - self._frame.t_arrival >= self._period:
            seq = self._frame.seq + 1
            self._frame = Frame(seq, now, now, True, self._chance.choice(self._counts))
        return self._frame


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
