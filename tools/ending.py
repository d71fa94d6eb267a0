"""End of a subcommand: by a signal, after a duration, or with the process that started it."""

from __future__ import annotations

import contextlib
import math
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, Self


def known(*names: str) -> tuple[signal.Signals, ...]:
    """Return those signals that this system has."""
    return tuple(each for each in signal.Signals if each.name in names)


class Ending:
    """A context in which signals ask for the end, as does the end of ``duration`` s.

    So does the end of ``lifeline``, a pipe whose other end is the process that started this one.
    """

    signals: tuple[signal.Signals, ...] = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, duration: float | None = None, lifeline: int | None = None) -> None:
        self._asked = False
        self._duration = math.inf if duration is None else duration
        self._deadline = math.inf
        self._lifeline = [] if lifeline is None else [lifeline]

    def begin(self) -> None:
        """The duration counts from now on."""
        self._deadline = time.monotonic() + self._duration

    @property
    def asked(self) -> bool:
        """A signal has come, or the lifeline has ended."""
        return self._asked

    @property
    def over(self) -> bool:
        """It is time to end."""
        return self.asked or time.monotonic() >= self._deadline

    def wait(self, seconds: float) -> bool:
        """Wait for the end, ``seconds`` at most; True when it has come."""
        self.ready(seconds)
        return self.over

    def ready(self, seconds: float, *others: int) -> list[int]:
        """Wait for the end, a signal or ``others``, ``seconds`` at most; which of these are ready.

        A signal that asks for no end ends the wait once.
        """
        left = min(seconds, self._deadline - time.monotonic())
        watched = [self._wakes.fileno(), *self._lifeline, *others]
        ready = select.select(watched, [], [], max(0.0, left))[0]
        if self._wakes.fileno() in ready and not self._asked:
            self._wakes.recv(4096)
        self._asked |= bool(set(self._lifeline).intersection(ready))
        return [each for each in ready if each in others]

    def end(self, *_: object) -> None:
        """Ask for the end; from a signal handler, too."""
        self._asked = True
        self.wake()

    def wake(self, *_: object) -> None:
        """End a wait."""
        # No lock, as an Event has: the signal may come while this very thread holds it.
        with contextlib.suppress(BlockingIOError):  # it is full: that wakes, too
            self._wake.send(b"!")

    def __enter__(self) -> Self:
        self._wakes, self._wake = socket.socketpair()  # Windows can't wait for a pipe
        self._wake.setblocking(False)
        self._before = {number: signal.signal(number, self.end) for number in self.signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._wakes.close()
        self._wake.close()


class Interrupted(BaseException):
    """A signal asked for the end before anything ran. No ``except Exception`` may hold it up."""


# A signal whose default ends the process without a word would leave torque to the watchdog.
# SIGHUP: the terminal is gone.
_ENDING = known("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR2", "SIGALRM")


class Signals:
    """Every signal that would end the process ends it quietly, at any stage."""

    def __init__(self) -> None:
        self._end_running: Callable[[], None] | None = None
        self._ended = self._held = False
        for number in _ENDING:
            signal.signal(number, self._end)

    def hand_over(self, end: Callable[[], None]) -> None:
        """Let signals call ``end`` from now on. Raises Interrupted when one came before."""
        self._end_running = end
        if self._ended:
            raise Interrupted

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep signals waiting meanwhile."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        if self._ended:
            raise Interrupted

    def _end(self, *_: Any) -> None:
        first, self._ended = not self._ended, True
        if self._end_running is not None:
            self._end_running()
        elif first and not self._held:  # a second one would cut the clean end short
            raise Interrupted
