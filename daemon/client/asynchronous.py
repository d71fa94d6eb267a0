"""Provide `AsyncHand`, the asyncio version of `client.hand.Hand`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, TypeVar

import zmq
import zmq.asyncio

from softfinger.daemon.client.command_client import (
    IS_DONE,
    RETRY_DELAY,
    Attempts,
    HandClient,
    NoAnswer,
    accepted,
    send_once,
)
from softfinger.daemon.client.stream import Subscriber, Wait, no_stream
from softfinger.daemon.errors import NoStream, Refused
from softfinger.daemon.wire.schema import EVENT, STATE, TACTILE, Event, HandState, TactileFrame

_Record = TypeVar("_Record")


async def _in_own_thread(job: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Run ``job`` in a new thread. Pending commands may occupy all threads of asyncio's pool."""
    pool = ThreadPoolExecutor(1)
    try:
        return await asyncio.get_running_loop().run_in_executor(pool, job, *arguments)
    finally:
        pool.shutdown(wait=False)


class AsyncSubscription(Subscriber[_Record]):
    """Asyncio version of `Subscription`; use it with ``async for record in hand.stream()``."""

    def __aiter__(self) -> AsyncIterator[_Record]:
        return self

    async def __anext__(self) -> _Record:
        return await self.next(self._timeout)

    async def next(self, timeout: float | None) -> _Record:
        """Return the next record; raise NoStream if no record arrives within ``timeout`` s."""
        for milliseconds in self._waits(timeout):
            if await self._socket.poll(milliseconds):
                record = self._take(await self._socket.recv_multipart())
                if record is not None:
                    return record
        raise no_stream(self._address, self._topic, timeout or 0.0)

    async def skip(self) -> None:
        """Drop queued messages so that `next` returns a new record."""
        self._require_open()
        while await self._socket.poll(0):
            self._take(await self._socket.recv_multipart())

    async def __aenter__(self) -> AsyncSubscription[_Record]:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class AsyncHand(HandClient[Coroutine[Any, Any, None]]):
    """Asyncio version of `client.hand.Hand`; use it with ``async with AsyncHand() as hand``.

    The parameters, methods and exceptions are the same as those of `Hand`.
    """

    _CONTEXT = zmq.asyncio.Context
    _states: AsyncSubscription[HandState] | None = None

    async def __aenter__(self) -> AsyncHand:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    async def state(self, timeout: float | None = None) -> HandState:
        """Drop queued states, then wait for a new state and return it. Raises NoStream."""
        if self._states is None:
            self._states = self.stream()
        else:
            await self._states.skip()
        return await self._states.next(self.timeout if timeout is None else timeout)

    def stream(self, timeout: float | None = None) -> AsyncSubscription[HandState]:
        """Subscribe to all states that the daemon publishes."""
        return self._subscription(STATE, timeout)

    def frames(self, timeout: float | None = None) -> AsyncSubscription[TactileFrame]:
        """Subscribe to both fingers' tactile frames; `TactileFrame.finger` is the finger's name."""
        return self._subscription(TACTILE, timeout)

    def events(self, timeout: float | None = None) -> AsyncSubscription[Event]:
        """Subscribe to the daemon's events, such as mode changes, faults and warnings."""
        return self._subscription(EVENT, timeout)

    def _subscription(self, topic: bytes, timeout: float | None) -> AsyncSubscription[Any]:
        self._require_open()
        return AsyncSubscription(self._context, self.stream_address, topic, timeout, self._thread)

    async def collect(self, seconds: float) -> list[HandState]:
        """Collect all states for ``seconds``, timed by the daemon's clock. Raises NoStream."""
        async with self.stream(self.timeout) as states:
            collected = [await anext(states)]
            end = collected[0].mono_ns + round(seconds * 1e9)
            async for state in states:
                if state.mono_ns >= end:
                    break
                collected.append(state)
        return collected

    async def wait_for(
        self, condition: Callable[[HandState], object], timeout: float = 10.0
    ) -> HandState:
        """Wait for a new state that satisfies ``condition``, and return it.

        Raises the same exceptions as `Hand.wait_for`.
        """
        wait = Wait(condition, timeout, self._now)
        async with self.stream() as states:
            while True:
                try:
                    state = await states.next(wait.left())
                except NoStream:
                    raise wait.over(self.stream_address) from None
                if wait.ends_with(state):
                    return state

    async def command(self, name: str, **numbers: float | None) -> dict[str, Any]:
        """Send one command and return the reply; see `Hand.command`."""
        attempts = Attempts(self._request(name, numbers), self.timeout)
        where, keys = self.command_address, self._keys
        reply = await _in_own_thread(send_once, where, attempts, keys)
        while attempts.again(reply):
            await asyncio.sleep(RETRY_DELAY)
            if not attempts.remaining():  # The computer was suspended.
                break
            reply = await _in_own_thread(send_once, where, attempts, keys)
        return accepted(reply)

    async def _carry_out(self, command: str, **numbers: float | None) -> None:
        try:
            await self.command(command, **numbers)
        except Refused:
            if command in IS_DONE:
                with suppress(NoAnswer, Refused):
                    if IS_DONE[command](await self.status()):
                        return
            raise

    async def status(self) -> dict[str, Any]:
        """Return the mode, the fault, the torque state, and the servo and sensor counters."""
        return await self.command("status")
