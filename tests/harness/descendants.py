"""The processes that tests started, whoever started them: to end what a test left running."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PR_SET_CHILD_SUBREAPER = 36  # from <linux/prctl.h>


@contextlib.contextmanager
def ending(process: subprocess.Popen[Any]) -> Iterator[subprocess.Popen[Any]]:
    """A process that is killed at the end, where ``with`` alone would wait for it for ever."""
    with process:
        try:
            yield process
        finally:
            process.kill()


def adopt_orphans() -> None:
    """Whatever runs below this process stays below it when the process between them ends."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def running(process: int | None = None) -> set[int]:
    """The children of a process, of this one by default, by their numbers."""
    tasks = Path(f"/proc/{process or os.getpid()}/task").glob("*/children")
    found: set[int] = set()
    for task in tasks:
        with contextlib.suppress(OSError):  # it ended meanwhile
            found |= set(map(int, task.read_text().split()))
    return found


def end(processes: set[int]) -> None:
    """Kill children of this process with all that runs below them."""
    for process in processes:
        below = running(process)
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(process, 0)
        end(below)  # by now they are children of this process
