"""Run a process on a pseudo-terminal and reconstruct its screen."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable
from typing import Any

import pyte

_CAPACITY = 1 << 16  # capacity of a terminal buffer [bytes]
_TIMEOUT = 150.0  # s
ENVIRONMENT = {"TERM": "xterm-256color", "COLORTERM": "truecolor", "LANG": "C.UTF-8"}


class TerminalProcess:
    """Run ``command`` with a pty as its controlling terminal; ``screen`` holds its output."""

    def __init__(self, command: list[str], columns: int = 80, lines: int = 24) -> None:
        self.master, self.slave = pty.openpty()
        self.screen = pyte.Screen(columns, lines)
        self._stream = pyte.ByteStream(self.screen)
        self.written = b""
        self.resize(columns, lines, tell=False)
        self.attributes = termios.tcgetattr(self.slave)
        environment = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
        self.process: subprocess.Popen[bytes] = subprocess.Popen(
            command,
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            env=environment | ENVIRONMENT,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )

    def resize(self, columns: int, lines: int, tell: bool = True) -> None:
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        if tell:
            self.screen.resize(lines, columns)
            self.screen.reset()

    def pump(self, seconds: float = 0.02) -> None:
        """Read the available output; if there is none, wait for output for up to ``seconds``.

        At most one terminal buffer is read, because the process may write faster than the test
        reads.
        """
        end = len(self.written) + _CAPACITY
        while len(self.written) < end and select.select([self.master], [], [], seconds)[0]:
            data = os.read(self.master, _CAPACITY)
            self.written += data
            self._stream.feed(data)
            seconds = 0.0

    def text(self) -> str:
        return "\n".join(self.screen.display)

    def wait(self, condition: Callable[[], Any]) -> None:
        """Read output until ``condition`` is true; on a timeout, fail with the screen's text."""
        deadline = time.monotonic() + _TIMEOUT
        while not condition():
            self.pump()
            if time.monotonic() > deadline:
                raise AssertionError(f"not within {_TIMEOUT:g} s; the page:\n{self.text()}")

    def shows(self, *texts: str) -> None:
        def shown() -> bool:
            page = self.text()
            return all(text in page for text in texts)

        self.wait(shown)

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    def ended(self) -> int:
        """Wait for the process to exit; return its exit status."""
        self.wait(lambda: self.process.poll() is not None)
        self.pump()
        return self.process.returncode

    def is_restored(self) -> bool:
        """Return True if terminal modes, main screen, cursor and bracketed paste are restored."""
        self.pump()
        pairs = ((b"\x1b[?1049h", b"\x1b[?1049l"), (b"\x1b[?25l", b"\x1b[?25h"))
        pairs += ((b"\x1b[?2004h", b"\x1b[?2004l"),)
        # For each pair, the process must have sent the first sequence and later the second.
        given = all(0 <= self.written.rfind(a) < self.written.rfind(b) for a, b in pairs)
        return given and termios.tcgetattr(self.slave) == self.attributes

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
            self.process.wait()
        os.close(self.master)
        os.close(self.slave)

    def __enter__(self) -> TerminalProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
