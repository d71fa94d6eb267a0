"""Run an emulated hand and its daemon as processes, and inject faults for a soak test."""

from __future__ import annotations

import contextlib
import json
import random
import resource
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import zmq

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.profile.load import find, load
from softfinger.daemon.simulation.emulator.folder import carry_out
from softfinger.daemon.wire.schema import STATE
from softfinger.tools.benchmarks.rigs import RigError
from softfinger.tools.processes.emulate import emulator_process
from tests.harness.daemon_process import SOFTFINGER

_PATIENCE = 300.0  # timeout for the start of a process, including kernel compilation [s]
_STATE_RATE = 250.0  # Hz
# On a busy machine, the first bytes from the emulated hand may arrive late.
_PATIENT = [word for key in ("servos", "tactile") for word in ("--set", f"{key}.open_timeout=60")]
_POLL = 0.003  # time between polls of the stream [s]
_SLACK = 0.05  # tolerance for delays of a process [s]
_RESOLUTION = 0.0016  # one encoder count [rad]
_CURRENT_UNIT = 0.0027  # A
_ROOM = 1 << 18  # number of bytes by which the address space may grow


class Rig:
    """An emulated hand and its daemon, which run in two processes that can be restarted.

    Checks of the data sent to the servos use the emulated hand's record, not the daemon's reports.
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
        hil = find(Path("hil")).read_text(encoding="utf-8")
        self.config.write_text(head + hil, encoding="utf-8")
        self.settings = load(self.config, self.ports)
        self.context: zmq.Context[Any] = zmq.Context()
        self._running = contextlib.ExitStack()  # context of the emulated hand
        self.hand: subprocess.Popen[str] | None = None
        self.hand_words: tuple[str, ...] = ()  # additional arguments of `softfinger emulate`
        self.daemon: subprocess.Popen[bytes] | None = None
        self._states: zmq.Socket[bytes] | None = None

    def start(self, *words: str) -> None:
        """Start processes that are not running; pass ``words`` to the daemon. Raises RigError."""
        if self.hand is None or self.hand.poll() is not None:
            self.hand = self._running.enter_context(
                emulator_process("--dir", self.ports, "--config", self.config, *self.hand_words)
            )
        if not self.alive:
            self.start_daemon(*words)

    def start_daemon(self, *more: str) -> None:
        """Start the daemon and wait for its first reply. Raises RigError."""
        end = time.monotonic() + _PATIENCE
        words = ["run", "--config", str(self.config), "--dir", str(self.ports), *_PATIENT, *more]
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
        """Signal the daemon; return its exit status, or None if it had to be killed."""
        daemon, self.daemon = self.daemon, None
        if daemon is None:
            return 0
        daemon.send_signal(number)
        try:
            return daemon.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()
            return None

    def close(self) -> None:
        if self.daemon is not None and self.daemon.poll() is None:
            self.daemon.send_signal(signal.SIGCONT)
            self.daemon.kill()
            self.daemon.wait()
        self._running.close()
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
        """Send words to the emulated hand's control socket. Raises RigError."""
        try:
            return carry_out(self.ports, words)
        except SoftfingerError as error:
            raise RigError(str(error)) from None

    def report(self, more: str = "") -> dict[str, Any]:
        """Return the record of the servo bus; if ``more`` is ``forget``, start a new record."""
        report: dict[str, Any] = json.loads(self.send(f"report {more}"))
        return report

    def ask(self, request: dict[str, Any], timeout: float = 2.0) -> dict[str, Any]:
        """Send one command and return its reply. Raises NoAnswer."""
        return send(self.commands, request, timeout)

    def status(self, timeout: float = 0.5) -> dict[str, Any] | None:
        """Return the daemon's status, or None if it does not reply."""
        try:
            status = self.ask({"command": "status"}, timeout)
        except NoAnswer:
            return None
        return status if status["ok"] else None

    def states(self, wait: float = _POLL) -> list[dict[str, Any]]:
        """Return the states received since the last call; wait up to ``wait`` [s] for the first."""
        found: list[dict[str, Any]] = []
        assert self._states is not None
        while self._states.poll(0 if found else int(wait * 1000)):
            found.append(msgpack.unpackb(self._states.recv_multipart()[1]))
        return found


# An Inject function starts a fault and returns the End function of the fault.
End = Callable[[], object]
Inject = Callable[[Rig, random.Random], End]


def _sent(begin: str, end: str = "well", *, places: tuple[Any, ...] = ("",)) -> Inject:
    """Return a fault that sends words to the hand, with ``{}`` replaced by one of ``places``."""

    def inject(rig: Rig, chance: random.Random) -> End:
        place = chance.choice(places)
        rig.send(begin.format(place))
        return lambda: rig.send(end.format(place)) if end else None

    return inject


_servo = partial(_sent, places=(1, 2))


def _board(begin: str, end: str = "{}:well") -> Inject:
    return _sent(begin, end, places=("left", "right"))


def _stood_still(rig: Rig, chance: random.Random) -> End:
    """Suspend the daemon's process for 2 s."""
    assert rig.daemon is not None
    rig.daemon.send_signal(signal.SIGSTOP)
    timer = threading.Timer(2.0, rig.daemon.send_signal, (signal.SIGCONT,))
    timer.start()
    return timer.join


def _without_memory(rig: Rig, chance: random.Random) -> End:
    """Allow the daemon only _ROOM more bytes of address space, and send requests to the daemon."""
    assert rig.daemon is not None
    process = rig.daemon.pid
    _, hard = resource.prlimit(process, resource.RLIMIT_AS)
    size = int(Path(f"/proc/{process}/statm").read_text().split()[0]) * resource.getpagesize()
    resource.prlimit(process, resource.RLIMIT_AS, (size + _ROOM, hard))
    for _ in range(chance.randint(5, 50)):
        if rig.status() is None:
            break
    return lambda: rig.alive and resource.prlimit(process, resource.RLIMIT_AS, (hard, hard))


CASES: dict[str, Inject] = {
    "replies dropped, 10%": _sent("drop=0.1"),
    "replies corrupted, 10%": _sent("corrupt=0.1"),
    "replies dropped, 100%": _sent("drop=1"),
    "one servo silent": _servo("silent={}", "answer={}"),
    "one servo rebooted": _servo("reboot={}", ""),
    "one servo overheated": _servo("overheat={0}", "recover={0} reboot={0}"),
    "one servo's readings frozen": _servo("frozen={}", "recover={}"),
    "writes lost, 100%": _sent("lose-writes=1"),
    "90% lost each way": _sent("lose=0.9 drop=0.9"),
    "servos' port gone and back": _sent("unplug", "plug"),
    "board silent": _board("{}:silent"),
    "board torn, 100%": _board("{}:torn=1"),
    "board's port gone and back": _board("{}:unplug", "{}:plug"),
    "board frozen": _board("{}:frozen"),
    "board zero": _board("{}:zero"),
    "daemon stood still for 2 s": _stood_still,
    "daemon without memory": _without_memory,
}


def judge_wire(rig: Rig) -> str:
    """Return an error found in the emulated hand's record of the servo bus, or "".

    In the record, goals must be within their limits. Torque must be switched on only near the goal.
    While torque is on, packets must keep arriving.
    """
    settings = rig.settings
    wrong = ""
    hand, most = settings.hand, settings.safety.current_max + _CURRENT_UNIT
    for i, servo in enumerate(rig.report()["servos"]):
        q, current = servo["goal_q"], servo["goal_current"]
        low, high = hand.q_min[i] - _RESOLUTION, hand.q_max[i] + _RESOLUTION
        if q is not None and not (low <= q[0] and q[-1] <= high):
            wrong = f"goal angles {q} rad on the wire"
        if current is not None and not all(abs(each) <= most for each in current):
            wrong = f"goal currents {current} A on the wire"
        if servo["torque_on"]["far"]:
            wrong = f"torque on {servo['torque_on']['farthest']:.3f} rad off its goal"
        quiet, limit = servo["longest_quiet"], settings.servos.watchdog + 0.02
        if quiet > limit + _SLACK and not servo["watchdog_fired"]["count"]:
            wrong = f"torque on for {quiet:.3f} s without a packet"
        if servo["goals_refused"] and not servo["watchdog_fired"]["count"]:
            wrong = f"{servo['goals_refused']} goals that the servo refused"
    return wrong
