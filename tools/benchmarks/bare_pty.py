"""The least that a cycle over a pseudo-terminal can cost on this machine: its bytes, and no work.

As a program this is the far end: it answers each message that asks with as many bytes as it was
started with, and ends when its pseudo-terminal does.
"""

from __future__ import annotations

import contextlib
import os
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator

_ASKS = b"?"
_TELLS = b"!"


class BareCycle:
    """Sends as many bytes as a read's request, waits for its reply's, sends a write's."""

    def __init__(self, terminal: int, request: int, reply: int, write: int) -> None:
        self._terminal = terminal
        self._request = _ASKS.ljust(request)
        self._reply = reply
        self._write = _TELLS.ljust(write)

    def __call__(self) -> None:
        """One cycle."""
        terminal, due = self._terminal, self._reply
        os.write(terminal, self._request)
        while due > 0:
            due -= len(os.read(terminal, due))
        os.write(terminal, self._write)


@contextlib.contextmanager
def bare(request: int, reply: int, write: int) -> Iterator[BareCycle]:
    """A cycle of these sizes [bytes], with its far end in a process of its own."""
    near, far = pty.openpty()
    tty.setraw(far)
    process = subprocess.Popen(
        [sys.executable, "-S", __file__, str(near), str(reply)], pass_fds=(near,)
    )
    os.close(near)
    try:
        cycle = BareCycle(far, request, reply, write)
        cycle()  # answered once the process is up
        yield cycle
    finally:
        process.terminate()
        process.wait()
        os.close(far)


def _answer(terminal: int, reply: bytes) -> None:
    while data := os.read(terminal, 4096):
        for _ in range(data.count(_ASKS)):
            os.write(terminal, reply)


if __name__ == "__main__":
    _answer(int(sys.argv[1]), bytes(int(sys.argv[2])))
