"""Waiting for many descriptors."""

from __future__ import annotations

import select
import time
from collections import deque
from collections.abc import Callable

_READY = 64  # descriptors asked for at once


class Poller:
    """Waits for descriptors and calls what each was given."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._calls: dict[int, Callable[[int], None]] = {}
        self._due: deque[tuple[int, int, Callable[[int], None]]] = deque()

    def watch(self, fd: int, events: int, call: Callable[[int], None]) -> None:
        """Call ``call`` with what happened, whenever something does."""
        self._calls[fd] = call
        self._epoll.register(fd, events)

    def change(self, fd: int, events: int) -> None:
        """Wait for something else."""
        self._epoll.modify(fd, events)

    def forget(self, fd: int) -> None:
        """Wait for it no more."""
        del self._calls[fd]
        self._epoll.unregister(fd)

    def step(self, seconds: float, most: float) -> None:
        """Wait for ``seconds`` at most, and call for ``most`` s; the rest is called next time."""
        if not self._due:
            for fd, events in self._epoll.poll(seconds, _READY):
                self._due.append((fd, events, self._calls[fd]))
        until = time.monotonic() + most
        while self._due:
            fd, events, call = self._due.popleft()
            if self._calls.get(fd) is call:  # else it was forgotten meanwhile
                call(events)
            if time.monotonic() > until:
                return

    def close(self) -> None:
        """Forget all."""
        self._epoll.close()
