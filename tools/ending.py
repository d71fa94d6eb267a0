"""When a subcommand ends: by a signal, or after a duration."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import time
from collections.abc import Iterator
from typing import Any, Protocol


class Ending:
    """A context in which SIGINT and SIGTERM ask for the end, as does the end of ``duration`` s."""

    def __init__(self, duration: float | None = None) -> None:
        self._asked = False
        self._duration = math.inf if duration is None else duration
        self._deadline = math.inf

    def begin(self) -> None:
        """The duration counts from now on."""
        self._deadline = time.monotonic() + self._duration

    @property
    def asked(self) -> bool:
        """A signal has come."""
        return self._asked

    @property
    def over(self) -> bool:
        """It is time to end."""
        return self.asked or time.monotonic() >= self._deadline

    def wait(self, seconds: float) -> bool:
        """Wait for the end, ``seconds`` at most; True when it has come."""
        left = self._deadline - time.monotonic()
        select.select([self._wakes], [], [], max(0.0, min(seconds, left)))
        return self.over

    def _ask(self, *_: object) -> None:
        # No lock, as an Event has: the signal may come while this very thread holds it.
        if not self._asked:
            self._asked = True
            os.write(self._wake, b"!")

    def __enter__(self) -> Ending:
        self._wakes, self._wake = os.pipe()
        self._before = {
            number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._wakes)
        os.close(self._wake)


class Endable(Protocol):
    """What runs until its end is asked for, at any moment: a loop, an emulator."""

    def end(self) -> None:
        """End soon."""


class Interrupted(BaseException):
    """A signal asked for the end before anything ran. No ``except Exception`` may hold it up."""


class Signals:
    """SIGINT, SIGTERM and SIGHUP (the terminal is gone) end, quietly, at whatever stage."""

    def __init__(self) -> None:
        self._running: Endable | None = None
        self._ended = self._held = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._end)

    def hand_over(self, running: Endable) -> None:
        """From now on signals end ``running``. Raises Interrupted when one came before."""
        self._running = running
        if self._ended:
            raise Interrupted

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Signals wait meanwhile."""
        self._held = True
        yield
        self._held = False
        if self._ended:
            raise Interrupted

    def _end(self, *_: Any) -> None:
        self._ended = True
        if self._running is not None:
            self._running.end()
        elif not self._held:
            raise Interrupted
