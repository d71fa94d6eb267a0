"""Waiting for many descriptors."""

from __future__ import annotations

import select
from collections.abc import Callable

_READY = 64  # descriptors served at a step


class Poll:
    """Waits for descriptors and calls what each was given."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._calls: dict[int, Callable[[int], None]] = {}

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

    def step(self, seconds: float) -> None:
        """Wait so long at most, and call."""
        for fd, events in self._epoll.poll(seconds, _READY):
            call = self._calls.get(fd)
            if call is not None:  # else it was hung up on at this step
                call(events)

    def close(self) -> None:
        """Forget all."""
        self._epoll.close()
