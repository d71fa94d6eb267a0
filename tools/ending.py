"""When a subcommand ends: by Ctrl-C, SIGTERM, or after a duration."""

from __future__ import annotations

import math
import signal
import threading
import time


class Ending:
    """A context in which SIGINT and SIGTERM ask for the end, as does the end of ``duration`` s."""

    def __init__(self, duration: float | None = None) -> None:
        self._asked = threading.Event()
        self._duration = math.inf if duration is None else duration
        self._deadline = math.inf

    def begin(self) -> None:
        """The duration counts from now on."""
        self._deadline = time.monotonic() + self._duration

    @property
    def asked(self) -> bool:
        """A signal has come."""
        return self._asked.is_set()

    @property
    def over(self) -> bool:
        """It is time to end."""
        return self.asked or time.monotonic() >= self._deadline

    def wait(self, seconds: float) -> bool:
        """Wait for the end, ``seconds`` at most; True when it has come."""
        left = self._deadline - time.monotonic()
        return self._asked.wait(max(0.0, min(seconds, left))) or self.over

    def __enter__(self) -> Ending:
        self._before = {
            number: signal.signal(number, lambda *_: self._asked.set())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
