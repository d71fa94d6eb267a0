"""The hardware-in-the-loop set-up that faults are injected into: two processes and their wires.

The emulated hand and the daemon run as users run them. What reached the servos is read
from the emulated hand's record, never from the daemon.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgpack
import zmq

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.profile.load import load
from softfinger.daemon.simulation.emulator.folder import NoEmulator, send_words
from softfinger.daemon.wire.schema import STATE
from softfinger.tools.benchmarks.framework.campaign import RigError
from softfinger.tools.benchmarks.framework.rigs import HIL

SOFTFINGER = (sys.executable, "-m", "softfinger")
_PATIENCE = 120.0  # s for a process to be ready: kernels may be new
_STATE_RATE = 250.0  # Hz
_LOOK = 0.003  # s between two looks at the hand


class Rig:
    """An emulated hand and a daemon on it, each of which can be started again."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="softfinger-faults-")
        self.folder = Path(self._folder.name)
        self.ports = self.folder / "hand"
        self.ports.mkdir()
        self.stream = f"ipc://{self.folder}/stream"
        self.commands = f"ipc://{self.folder}/commands"
        self.config = self.folder / "hil.toml"
        head = (
            f'stream.address = "{self.stream}"\ncommands.address = "{self.commands}"\n'
            f"stream.state_rate = {_STATE_RATE}\n"
        )
        self.config.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
        self.settings = load(self.config, self.ports)
        self.context: zmq.Context[Any] = zmq.Context()
        self.hand: subprocess.Popen[str] | None = None
        self.daemon: subprocess.Popen[bytes] | None = None
        self._states: zmq.Socket[bytes] | None = None
        self._last_waited: dict[int, float] = {}

    def start_hand(self) -> None:
        """Start the emulated hand, and wait until it answers. Raises RigError."""
        words = [*SOFTFINGER, "emulate", "--dir", str(self.ports), "--config", str(self.config)]
        self.hand = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self.hand.stdout is not None
        if self.hand.stdout.readline().strip() != "ready":
            raise RigError("the emulated hand did not start")

    def start_daemon(self) -> None:
        """Start the daemon, and wait for its first answer; once more where it ends. RigError."""
        if not self._started() and not self._started():
            raise RigError(f"the daemon did not start: {self.log()[-1:]}")
        self._subscribe()

    def _started(self) -> bool:
        begin = time.monotonic()
        words = ["run", "--config", str(self.config), "--dir", str(self.ports)]
        log = str(self.folder / "daemon.log")
        daemon = subprocess.Popen([*SOFTFINGER, *words, "--log-file", log])
        self.daemon = daemon
        while self.status() is None:
            if daemon.poll() is not None:
                return False
            if time.monotonic() > begin + _PATIENCE:
                daemon.kill()
                daemon.wait()
                return False
        return True

    def start(self) -> None:
        """Start whatever does not run."""
        if self.hand is None or self.hand.poll() is not None:
            self.start_hand()
        if self.daemon is None or self.daemon.poll() is not None:
            self.start_daemon()

    def end_daemon(self, number: int = signal.SIGTERM) -> int | None:
        """Signal the daemon and wait for it; None when it hangs, and had to be killed."""
        if self.daemon is None:
            return 0
        self.daemon.send_signal(number)
        try:
            return self.daemon.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            self.daemon.kill()
            self.daemon.wait()
            return None
        finally:
            self.daemon = None

    def close(self) -> None:
        for process in (self.daemon, self.hand):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.wait()
        if self.hand is not None and self.hand.stdout is not None:
            self.hand.stdout.close()
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
        """Words for the emulated hand's control socket; its reply. Raises RigError."""
        try:
            reply = send_words(self.ports, words)
        except NoEmulator as error:
            raise RigError(str(error)) from None
        if reply.startswith("error: "):
            raise RigError(reply)
        return reply

    def report(self, more: str = "") -> dict[str, Any]:
        """What was on the servos' wire; ``more``: ``forget`` begins the record anew, ``goals``."""
        report: dict[str, Any] = json.loads(self.send(f"report {more}"))
        return report

    def ask(self, request: dict[str, Any], timeout: float = 2.0) -> dict[str, Any]:
        """One command and its reply. Raises NoAnswer."""
        socket = self.context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        try:
            socket.connect(self.commands)
            socket.send(msgpack.packb(request))
            if not socket.poll(int(timeout * 1000)):
                raise NoAnswer(f"no answer to {request['command']} within {timeout:g} s")
            reply: dict[str, Any] = msgpack.unpackb(socket.recv())
        finally:
            socket.close()
        return reply

    def status(self, timeout: float = 0.5) -> dict[str, Any] | None:
        """The daemon's status, None when it does not answer.

        Just after a stall it refuses even this: then it is asked again.
        """
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0.0:
            try:
                status = self.ask({"command": "status"}, left)
            except NoAnswer:
                return None
            if status["ok"]:
                return status
            time.sleep(_LOOK)
        return None

    def _subscribe(self) -> None:
        if self._states is not None:
            self._states.close()
        self._states = self.context.socket(zmq.SUB)
        self._states.setsockopt(zmq.LINGER, 0)
        self._states.subscribe(STATE)
        self._states.connect(self.stream)

    def states(self, wait: float = _LOOK) -> list[dict[str, Any]]:
        """States that came since the last call, none after ``wait`` s without one."""
        socket = self._states
        found: list[dict[str, Any]] = []
        if socket is None:
            time.sleep(wait)
            return []
        while socket.poll(0 if found else int(wait * 1000)):
            found.append(msgpack.unpackb(socket.recv_multipart()[1]))
        return found

    def waited(self) -> float:
        """Seconds that others held the processor that either process wanted, since last asked."""
        most = 0.0
        for process in (self.daemon, self.hand):
            if process is None:
                continue
            seconds = _waiting(process.pid)
            most = max(most, seconds - self._last_waited.get(process.pid, seconds))
            self._last_waited[process.pid] = seconds
        return most


def _waiting(process: int) -> float:
    """How long a process's threads have been ready to run and did not, altogether [s].

    All of them: while one waits with the interpreter's lock, the others can't go on.
    """
    try:
        tasks = list(Path(f"/proc/{process}/task").iterdir())
        return 1e-9 * sum(int((task / "schedstat").read_text().split()[1]) for task in tasks)
    except (OSError, IndexError, ValueError):
        return 0.0


def stopped(report: dict[str, Any]) -> bool:
    """Whether no motor is driven: torque off, or stopped by the servo's own watchdog."""
    return all(not servo["torque"] or servo["stopped_by_watchdog"] for servo in report["servos"])
