"""Run ``softfinger`` in separate processes: daemons, subcommands and installed plugins."""

import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softfinger.daemon.client.command_client import send

ROOT = Path(__file__).parents[2]
SOFTFINGER = [sys.executable, "-m", "softfinger"]
# Settings that tolerate stalls on a busy machine, for tests that are not about timeouts.
PATIENCE = {
    "servos.open_timeout": 60.0,
    "servos.reply_timeout": 0.1,
    "servos.watchdog": 0.0,
    "servos.fault_after": 60.0,
    "safety.frame_age_hold": 1000.0,
    "safety.frame_age_fault": 3000.0,
    "safety.frozen_after": 0.0,
    "safety.overruns_fault": 1_000_000,
}
PATIENT = [word for key, value in PATIENCE.items() for word in ("--set", f"{key}={value}")]


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program with this Python interpreter until it exits; return its status and output."""
    call = [sys.executable, *map(str, words)]
    return subprocess.run(call, capture_output=True, text=True, check=False, **options)


def softfinger(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a subcommand until it exits; return its status and output."""
    return python("-m", "softfinger", *words, **options)


def pip_installed(package: Path, folder: Path) -> Path:
    """Install one package of this repository with pip and return its location."""
    shutil.copytree(package, folder / "source")  # The build changes the copied folder.
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--quiet")
    words = ("install", *options, "--target", folder / "site", folder / "source")
    done = python("-m", "pip", *words)
    assert done.returncode == 0, done.stderr
    return folder / "site"


def plugin_path(folder: Path) -> str:
    """Make this repository's pytest plugin visible to other processes, as if it were installed.

    Write the metadata of a package to ``folder``, with the entry points of pyproject.toml. Return
    the resulting PYTHONPATH.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    entries = project["entry-points"]["pytest11"]
    info = folder / "softfinger_plugin-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: softfinger-plugin\nVersion: 0\n")
    lines = ["[pytest11]", *(f"{name} = {module}" for name, module in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return os.pathsep.join([str(folder), str(ROOT)])


def started(*words: object, **options: Any) -> subprocess.Popen[str]:
    """Start a subcommand with pipes for its output."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*SOFTFINGER, *map(str, words)], **pipes | options)


def ask(address: str, name: str, **numbers: float) -> dict[str, Any]:
    """Send a command and return the reply."""
    return send(address, {"command": name, **numbers}, timeout=120.0)


def until_it_says(words: Sequence[str | Path], text: str) -> None:
    """Run a tool until it prints a line with ``text``; then terminate it and check its status."""
    process = started(*words, stderr=None)
    assert any(text in line for line in process.stdout), f"{text!r} was not printed"
    process.terminate()
    process.communicate(timeout=300)
    assert process.returncode == 0


class Running:
    """A ``softfinger run`` process; the constructor returns once the process is ready."""

    def __init__(self, *words: str) -> None:
        self.lines: list[str] = []
        self.process = started("run", *words, stdout=None)
        for line in self.process.stderr:
            self.lines.append(line)
            if "running, disarmed" in line:
                return
        raise AssertionError("".join(self.lines))

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, read the remaining output and return the exit status."""
        self.process.send_signal(number)
        self.lines += self.process.stderr.readlines()
        return self.process.wait(timeout=300)

    def kill(self) -> None:
        """Kill the process if it is still running."""
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()
