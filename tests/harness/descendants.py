"""Find and kill processes that tests started, directly or indirectly.

If this module runs as a program, it waits until its standard input closes. The program then kills
every process whose environment contains the program's argument.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PR_SET_CHILD_SUBREAPER = 36  # from <linux/prctl.h>


@contextlib.contextmanager
def ending(process: subprocess.Popen[Any]) -> Iterator[subprocess.Popen[Any]]:
    """Kill the process on exit; ``with process`` alone would wait for the process forever."""
    with process:
        try:
            yield process
        finally:
            process.kill()


def adopt_orphans() -> None:
    """Adopt every descendant whose parent process exits."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_with_this_process() -> None:
    """Ensure that child processes are killed when this process ends or is itself killed."""
    word = f"TESTS_OF_PROCESS={os.getpid()}"
    _watching.append(
        subprocess.Popen(
            [sys.executable, "-S", __file__, word],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # The new session ignores Ctrl-C.
        )
    )
    os.environ["TESTS_OF_PROCESS"] = str(os.getpid())


# Processes whose standard input closes when this process exits.
_watching: list[subprocess.Popen[bytes]] = []


def running(process: int | None = None) -> set[int]:
    """Return the IDs of a process's children, by default of this process."""
    tasks = Path(f"/proc/{process or os.getpid()}/task").glob("*/children")
    found: set[int] = set()
    for task in tasks:
        with contextlib.suppress(OSError):  # The thread has ended.
            found |= set(map(int, task.read_text().split()))
    return found


def end(processes: set[int]) -> None:
    """Kill child processes and all their descendants."""
    for process in processes:
        below = running(process)
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(process, 0)
        end(below)  # The children of the killed process are now children of this process.


def _sweep(word: bytes) -> bool:
    """Kill every process with ``word`` in its environment; return True if any was found."""
    found = False
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # The process has exited or belongs to another user.
            if word in (folder / "environ").read_bytes().split(b"\0"):
                os.kill(int(folder.name), signal.SIGKILL)
                found = True
    return found


if __name__ == "__main__":
    sys.stdin.read()
    while _sweep(sys.argv[1].encode()):
        pass
