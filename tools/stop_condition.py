"""End a subcommand on a signal, after a time limit, or together with its parent process."""

from __future__ import annotations

import contextlib
import math
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, Self


def available_signals(*names: str) -> tuple[signal.Signals, ...]:
    """Return the named signals that exist on this system."""
    return tuple(each for each in signal.Signals if each.name in names)


class StopCondition:
    """Context manager that ends a subcommand on a signal, a time limit or a closed pipe.

    Parameters
    ----------
    duration
        Time limit [s], counted from `begin`.
    lifeline
        Read end of a pipe from the parent process. When the pipe closes, the subcommand should end.
    """

    signals: tuple[signal.Signals, ...] = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, duration: float | None = None, lifeline: int | None = None) -> None:
        # True if a signal has arrived or the pipe to the parent process has closed.
        self.is_requested = False
        self._duration = math.inf if duration is None else duration
        self._deadline = math.inf
        self._lifeline = [] if lifeline is None else [lifeline]

    def begin(self) -> None:
        """Start the time limit."""
        self._deadline = time.monotonic() + self._duration

    @property
    def is_met(self) -> bool:
        """True if the subcommand should end."""
        return self.is_requested or time.monotonic() >= self._deadline

    def wait(self, seconds: float) -> bool:
        """Wait up to ``seconds`` for a stop request; return True if the subcommand should end."""
        self.wait_readable(seconds)
        return self.is_met

    def wait_readable(self, seconds: float, *others: int) -> list[int]:
        """Wait up to ``seconds`` and return the readable descriptors among ``others``.

        A stop request or any other signal also interrupts the wait.
        """
        left = min(seconds, self._deadline - time.monotonic())
        watched = [self._wakes.fileno(), *self._lifeline, *others]
        readable = select.select(watched, [], [], max(0.0, left))[0]
        if self._wakes.fileno() in readable and not self.is_requested:
            self._wakes.recv(4096)
        self.is_requested |= bool(set(self._lifeline).intersection(readable))
        return [each for each in readable if each in others]

    def end(self, *_: object) -> None:
        """Ask the subcommand to end; this method may be called from a signal handler."""
        self.is_requested = True
        self.wake()

    def wake(self, *_: object) -> None:
        """Interrupt a wait."""
        # Do not use an Event here, because the interrupted thread may hold the Event's lock.
        with contextlib.suppress(BlockingIOError):  # A full buffer has already woken the thread.
            self._wake.send(b"!")

    def __enter__(self) -> Self:
        self._wakes, self._wake = socket.socketpair()  # On Windows, select requires sockets.
        self._wake.setblocking(False)
        self._before = {number: signal.signal(number, self.end) for number in self.signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._wakes.close()
        self._wake.close()


class Interrupted(BaseException):
    """Raised if a signal arrives before the daemon is running; deliberately not an `Exception`."""


# By default, these signals end the process immediately. Only the servo watchdog would then switch
# torque off. SIGHUP means that the terminal was closed.
_TERMINATING = available_signals("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR2", "SIGALRM")


class Signals:
    """Handle all terminating signals, so that shutdown is clean at any stage."""

    def __init__(self) -> None:
        self._end_running: Callable[[], None] | None = None
        self._has_ended = self._deferred = False
        for number in _TERMINATING:
            signal.signal(number, self._end)

    def hand_over(self, end: Callable[[], None]) -> None:
        """Let signals call ``end`` from now on; raise Interrupted if a signal arrived earlier."""
        self._end_running = end
        if self._has_ended:
            raise Interrupted

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer signals within this context; raise Interrupted on exit if a signal has arrived."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False
        if self._has_ended:
            raise Interrupted

    def _end(self, *_: Any) -> None:
        first, self._has_ended = not self._has_ended, True
        if self._end_running is not None:
            self._end_running()
        elif first and not self._deferred:  # A second signal must not interrupt the shutdown.
            raise Interrupted
