"""Events of the daemon as lines on standard error, written by a thread of their own.

A terminal that is held (Ctrl-S), a full pipe or a full disk stops a writer. The tick hands its
lines over and never writes itself; what can't be written is dropped.
"""

from __future__ import annotations

import sys
import threading
from collections import deque

_KEPT = 1000  # lines that wait for a slow reader; older ones are dropped


class EventLog:
    """Lines for people. ``line`` never waits and never fails."""

    def __init__(self) -> None:
        self.quiet = False  # while a page owns the terminal
        self._lines: deque[str] = deque(maxlen=_KEPT)
        self._news = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._write, name="event log", daemon=True)
        self._thread.start()

    def line(self, level: str, kind: str, text: str) -> None:
        """Hand over one event."""
        if not self.quiet:
            self.plain(f"{level:7} {kind:8} {text}")

    def plain(self, text: str) -> None:
        """Hand over one line as it is."""
        self._lines.append(text)
        self._news.set()

    def close(self, patience: float = 1.0) -> None:
        """Write what waits, for ``patience`` s at most."""
        self._closing = True
        self._news.set()
        self._thread.join(patience)

    def _write(self) -> None:
        while True:
            self._news.wait()
            self._news.clear()
            while self._lines:
                text = self._lines.popleft()
                try:
                    print(text, file=sys.stderr, flush=True)
                except (OSError, ValueError):
                    pass  # nobody can read it
            if self._closing:
                return
