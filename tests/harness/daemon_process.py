"""``softfinger`` as real processes: one that ends by itself, and a daemon that runs."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from softfinger import Refused
from softfinger.daemon.client.command_client import send

SOFTFINGER = [sys.executable, "-m", "softfinger"]
# A hand that sits out a busy machine's stalls, for tests that are not about its time-outs.
PATIENCE = {
    "servos.reply_timeout": 0.1,
    "servos.watchdog": 0.0,
    "servos.fault_after": 60.0,
    "safety.frame_age_hold": 1000.0,
    "safety.frame_age_fault": 3000.0,
    "safety.frozen_after": 0.0,
    "safety.overruns_fault": 1_000_000,
}
PATIENT = [word for key, value in PATIENCE.items() for word in ("--set", f"{key}={value}")]


def softfinger(*words: str, timeout: float = 300.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SOFTFINGER, *words], capture_output=True, text=True, timeout=timeout, check=False
    )


def ask(address: str, name: str, **numbers: float) -> dict[str, Any]:
    """The reply to a command, sent again where the daemon was held up and says so."""
    while True:
        reply = send(address, {"command": name, **numbers}, timeout=120.0)
        if reply["ok"] or "send it again" not in reply["error"]:
            return reply


def until_it_says(words: Sequence[str | Path], text: str) -> None:
    """Run a tool until it prints a line with ``text``; it is ended then, and must end well."""
    process = subprocess.Popen([*SOFTFINGER, *words], text=True, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert any(text in line for line in process.stdout), f"{text!r} never came"
    process.terminate()
    process.communicate(timeout=300)
    assert process.returncode == 0


def insist(command: Callable[[], object]) -> None:
    """Give a client's command, again where the daemon was held up and says so."""
    while True:
        try:
            command()
        except Refused as refused:
            if "send it again" not in str(refused):
                raise
        else:
            return


class Running:
    """A ``softfinger run`` in a process of its own, ready when constructed."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [*SOFTFINGER, "run", *words], stderr=subprocess.PIPE, text=True
        )
        self.lines: list[str] = []
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if "running, disarmed" in line:
                return
        raise AssertionError("".join(self.lines))

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, read the rest of what it says, and return the exit status."""
        self.process.send_signal(number)
        assert self.process.stderr is not None
        self.lines += self.process.stderr.readlines()
        return self.process.wait(timeout=300)

    def kill(self) -> None:
        """End it however it stands, if it has not ended yet."""
        self.process.kill()
        self.process.wait()
        assert self.process.stderr is not None
        self.process.stderr.close()
