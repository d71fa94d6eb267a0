"""The processes that tests started, whoever started them: to end what a test left running.

As a program, with a word, it waits for the end of its standard input, and then kills every process
that has this word in its environment.
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
    """A process that is killed at the end, where ``with`` alone would wait for it for ever."""
    with process:
        try:
            yield process
        finally:
            process.kill()


def adopt_orphans() -> None:
    """Whatever runs below this process stays below it when the process between them ends."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_with_this_process() -> None:
    """Have what this process starts from now on killed when it dies, be it by SIGKILL."""
    word = f"TESTS_OF_PROCESS={os.getpid()}"
    _watching.append(
        subprocess.Popen(
            [sys.executable, "-S", __file__, word],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not for it
        )
    )
    os.environ["TESTS_OF_PROCESS"] = str(os.getpid())


_watching: list[subprocess.Popen[bytes]] = []  # whose standard input ends with this process


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


def _sweep(word: bytes) -> bool:
    """Kill every process with ``word`` in its environment; whether there was one."""
    found = False
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it ended meanwhile, or is another user's
            if word in (folder / "environ").read_bytes().split(b"\0"):
                os.kill(int(folder.name), signal.SIGKILL)
                found = True
    return found


if __name__ == "__main__":
    sys.stdin.read()
    while _sweep(sys.argv[1].encode()):
        pass
