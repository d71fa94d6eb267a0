"""The monitor beside a daemon: `softfinger run --monitor` starts it as a child process.

Holds that child's life only: it owns the terminal while it runs, either end's death ends the other
cleanly, and the terminal comes back whatever happens to the child.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import termios
from collections.abc import Callable
from types import TracebackType
from typing import Any

LEAVE = "\x18\x1b[0m\x1b[?2004l\x1b[?25h\x1b[?1049l"


class Beside:
    """A running monitor. Close it, or use it as a context, before writing to the terminal."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        lifeline: int,
        terminal: int,
        attributes: list[Any] | None,
    ) -> None:
        self.process = process
        self._lifeline = lifeline
        self._terminal = terminal
        self._attributes = attributes

    def running(self) -> bool:
        """False once the person has quit the monitor, or it has died. Costs a system call."""
        return self.process.poll() is None

    def close(self, patience: float = 2.0) -> None:
        """End the monitor if it still runs, and wait until the terminal is back. Never raises."""
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1
        for end in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(patience)
                break
            except subprocess.TimeoutExpired:
                end()
        if self.process.wait() < 0 and self._attributes is not None:  # it could not tidy up
            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._terminal, termios.TCSANOW, self._attributes)
                os.write(self._terminal, LEAVE.encode())

    def __enter__(self) -> Beside:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def start_beside(
    state_address: str,
    command_address: str,
    keys: str = "",
    duration: float | None = None,
    on_end: Callable[[], None] | None = None,
) -> Beside:
    """Start the monitor on this process's terminal. From now on the page owns standard output.

    The child holds one end of a pipe whose other end is ours alone: when this process ends, in
    whatever way, the child reads the pipe's end and gives the terminal back. ``on_end`` is called
    once, from a signal handler in the main thread, when the monitor has ended: with
    ``on_end=loop.end`` the person's q ends the daemon, and the loop need not look. ``keys`` is the
    folder with the client's keys, if the daemon wants some.
    """
    attributes: list[Any] | None = None
    terminal = -1
    # A standard output that was closed, or is no file, is no terminal either.
    with contextlib.suppress(termios.error, AttributeError, OSError, ValueError):
        terminal = sys.stdout.fileno()
        attributes = termios.tcgetattr(terminal)
    reads, writes = os.pipe()
    # -P: a folder named tools where the daemon was started is not ours.
    command = [sys.executable, "-P", "-m", "softfinger.tools.monitor", "--state", state_address]
    command += ["--commands", command_address, "--lifeline", str(reads)]
    if keys:
        command += ["--keys", keys]
    if duration is not None:
        command += ["--duration", str(duration)]
    try:
        process = subprocess.Popen(command, pass_fds=(reads,))
    except BaseException:
        os.close(writes)
        raise
    finally:
        os.close(reads)
    beside = Beside(process, writes, terminal, attributes)
    if on_end is not None:
        _call_at_end(beside, on_end)
    return beside


def _call_at_end(beside: Beside, on_end: Callable[[], None]) -> None:
    called = False

    def child_changed(*_: Any) -> None:  # comes when the child was stopped or continued, too
        nonlocal called
        if not called and not beside.running():
            called = True
            on_end()

    signal.signal(signal.SIGCHLD, child_changed)
    child_changed()  # it may have ended before there was a handler
