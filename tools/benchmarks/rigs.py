"""Shared by several benchmarks: daemons that hold, canned backends, a hand and its daemon.

The emulated hand runs as users run it, in a process of its own; so does the daemon of `Rig`.
"""

from __future__ import annotations

import contextlib
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator.folder import NoEmulator, send_words
from softfinger.daemon.types import Frame, Goal, Reading
from softfinger.daemon.wire.schema import STATE

Sections = Mapping[str, Mapping[str, Any]]

HIL = Path(__file__).parents[2] / "config" / "hil.toml"
SOLID: Sections = {  # tips of solid rubber
    "tip": {"physics": "solid"},
    "material": {"law": "constant", "modulus": 0.15e6},
    "safety": {"d_max": 0.008},
}
SENSORS: dict[str, Sections] = {  # with flaws; the ideal one has noise alone
    name: load(Path(name)).model_dump(exclude_unset=True) for name in ("velostat", "capacitive")
}
SOFTFINGER = (sys.executable, "-m", "softfinger")
_KEPT = 16  # frames that take turns
_PATIENCE = 120.0  # s for a process to be ready: kernels may be new
_STATE_RATE = 250.0  # Hz
_POLL = 0.003  # s between two polls of the stream


class RigError(SoftfingerError):
    """The set-up itself does not work: nothing was measured."""


@contextlib.contextmanager
def emulator(folder: Path, config: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Yield the simulated hand behind ptys in ``folder``, in its own process, once it answers."""
    command = [*SOFTFINGER, "emulate", "--dir", str(folder), "--config", str(config), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise RigError("the emulated hand did not start")
            yield process
        finally:
            process.terminate()


def merged(sections: Sections, base: Sections) -> dict[str, dict[str, Any]]:
    """Return ``base`` with what ``sections`` have instead or besides."""
    names = dict.fromkeys((*base, *sections))
    return {name: {**base.get(name, {}), **sections.get(name, {})} for name in names}


@contextlib.contextmanager
def virtual_daemon(
    sections: Sections, *topics: str | bytes, subscribers: int = 1
) -> Iterator[Daemon]:
    """Yield a daemon on virtual time at its own addresses, with ``topics`` subscribed to."""
    with tempfile.TemporaryDirectory() as folder, zmq.Context() as context:
        base = {
            "loop": {"clock": "virtual"},
            "stream": {"address": f"ipc://{folder}/stream"},
            "commands": {"address": f"ipc://{folder}/commands"},
        }
        settings = Settings.model_validate(merged(sections, base))
        with Daemon(settings) as daemon:
            for _ in range(subscribers if topics else 0):
                socket = context.socket(zmq.SUB)
                socket.setsockopt(zmq.LINGER, 0)
                for topic in topics:
                    socket.subscribe(topic)
                socket.connect(settings.stream.address)
            try:
                yield daemon
            finally:
                context.destroy()


def hold(daemon: Daemon, force: float = 8.0) -> None:
    """Grasp the simulated object. Raises RigError when it is not held within 3 s, or Refused."""
    loop = daemon.loop
    loop.advance(0.2)
    loop.command({"command": "arm"})
    loop.advance(0.2)
    loop.command({"command": "grasp", "force": force})
    loop.advance(3.0)
    must_hold(daemon)


def must_hold(daemon: Daemon) -> None:
    """Raise RigError unless the hand holds."""
    state = daemon.loop.state
    if state.mode != "holding":
        raise RigError(f"the hand does not hold: {state.mode} {state.fault}")


class _Canned:
    """The part of a backend in which there is nothing to do."""

    def close(self) -> None:
        """Nothing to do."""

    connect = open = torque_on = close

    def counters(self) -> dict[str, int]:
        """Return no counters."""
        return {}


class CannedServos(_Canned):
    """Always the same good reading; goals go nowhere."""

    def __init__(self, reading: Reading, clock: Clock) -> None:
        self._clock = clock
        self._q = reading.q.copy()
        self._current = reading.current.copy()

    def read(self, reading: Reading) -> None:
        """Return the same again, taken now."""
        reading.seq += 1
        reading.valid = True
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.current[:] = self._current

    def torque_off(self, reading: Reading) -> bool:
        """Confirmed at once."""
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        """Nothing to do."""


class CannedSensor(_Canned):
    """The same few grids of counts in a random order, each a new frame, every ``period`` s."""

    def __init__(self, counts: list[NDArray[np.uint16]], period: float, clock: Clock) -> None:
        self._counts = counts
        self._period = period
        self._clock = clock
        self._chance = random.Random(1)
        self._frame = Frame(1, clock.now(), clock.now(), True, counts[0])

    def latest(self) -> Frame:
        """Return the newest frame."""
        now = self._clock.now()
        if now - self._frame.t_arrival >= self._period:
            seq = self._frame.seq + 1
            self._frame = Frame(seq, now, now, True, self._chance.choice(self._counts))
        return self._frame


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


class Rig:
    """An emulated hand and a daemon on it, two processes, each of which can be started again.

    What reached the servos is read from the emulated hand's record, never from the daemon.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="softfinger-rig-")
        self.folder = Path(self._folder.name)
        self.ports = self.folder / "hand"
        self.ports.mkdir()
        self.stream = f"ipc://{self.folder}/stream"
        self.commands = f"ipc://{self.folder}/commands"
        self.config = self.folder / "hil.toml"
        head = (
            f'stream.address = "{self.stream}"\ncommands.address = "{self.commands}"\n'
            f'stream.state_rate = {_STATE_RATE}\nloop.clock = "real"\n'
        )
        self.config.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
        self.settings = load(self.config, self.ports)
        self.context: zmq.Context[Any] = zmq.Context()
        self._running = contextlib.ExitStack()  # the emulated hand
        self.hand: subprocess.Popen[str] | None = None
        self.daemon: subprocess.Popen[bytes] | None = None
        self._states: zmq.Socket[bytes] | None = None

    def start(self) -> None:
        """Start whatever does not run. Raises RigError."""
        if self.hand is None or self.hand.poll() is not None:
            self.hand = self._running.enter_context(emulator(self.ports, self.config))
        if not self.alive:
            self.start_daemon()

    def start_daemon(self) -> None:
        """Start the daemon, and wait for its first answer. Raises RigError."""
        end = time.monotonic() + _PATIENCE
        words = ["run", "--config", str(self.config), "--dir", str(self.ports)]
        log = str(self.folder / "daemon.log")
        self.daemon = subprocess.Popen([*SOFTFINGER, *words, "--log-file", log])
        if self._states is not None:
            self._states.close()
        self._states = self.context.socket(zmq.SUB)
        self._states.setsockopt(zmq.LINGER, 0)
        self._states.subscribe(STATE)
        self._states.connect(self.stream)
        while self.status() is None:
            if not self.alive or time.monotonic() > end:
                raise RigError(f"the daemon did not start: {self.log()[-1:]}")

    def end_daemon(self, number: int = signal.SIGTERM) -> int | None:
        """Signal the daemon and wait for it; None when it hangs, and had to be killed."""
        daemon, self.daemon = self.daemon, None
        if daemon is None:
            return 0
        daemon.send_signal(number)
        try:
            return daemon.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()
            return None

    def end_hand(self) -> None:
        """End the emulated hand."""
        self._running.close()

    def close(self) -> None:
        if self.daemon is not None and self.daemon.poll() is None:
            self.daemon.send_signal(signal.SIGCONT)
            self.daemon.kill()
            self.daemon.wait()
        self.end_hand()
        self.context.destroy(linger=0)
        self._folder.cleanup()

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def log(self) -> list[str]:
        try:
            return (self.folder / "daemon.log").read_text(encoding="utf-8").splitlines()
        except OSError:
            return []

    @property
    def alive(self) -> bool:
        return self.daemon is not None and self.daemon.poll() is None

    def send(self, words: str) -> str:
        """Send words to the emulated hand's control socket; return its reply. Raises RigError."""
        try:
            reply = send_words(self.ports, words)
        except NoEmulator as error:
            raise RigError(str(error)) from None
        if reply.startswith("error: "):
            raise RigError(reply)
        return reply

    def report(self, more: str = "") -> dict[str, Any]:
        """Return what was on the servos' wire; ``more``: ``forget`` begins again."""
        report: dict[str, Any] = json.loads(self.send(f"report {more}"))
        return report

    def ask(self, request: dict[str, Any], timeout: float = 2.0) -> dict[str, Any]:
        """One command and its reply. Raises NoAnswer."""
        with self.context.socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(self.commands)
            socket.send(msgpack.packb(request))
            if not socket.poll(int(timeout * 1000)):
                raise NoAnswer(f"no answer to {request['command']} within {timeout:g} s")
            reply: dict[str, Any] = msgpack.unpackb(socket.recv())
        return reply

    def status(self, timeout: float = 0.5) -> dict[str, Any] | None:
        """Return the daemon's status, None when it does not answer."""
        try:
            status = self.ask({"command": "status"}, timeout)
        except NoAnswer:
            return None
        return status if status["ok"] else None

    def states(self, wait: float = _POLL) -> list[dict[str, Any]]:
        """Return states that came since the last call, none after ``wait`` s without one."""
        found: list[dict[str, Any]] = []
        assert self._states is not None
        while self._states.poll(0 if found else int(wait * 1000)):
            found.append(msgpack.unpackb(self._states.recv_multipart()[1]))
        return found


def stopped(report: dict[str, Any]) -> bool:
    """Return whether no motor is driven: torque off, or stopped by the servo's own watchdog."""
    return all(not servo["torque"] or servo["stopped_by_watchdog"] for servo in report["servos"])
