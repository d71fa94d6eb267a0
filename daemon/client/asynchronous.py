"""`AsyncHand`: what `client.hand.Hand` is, for asyncio."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgpack
import zmq
import zmq.asyncio

from softfinger.daemon.client.command_client import LOCALLY, NoAnswer
from softfinger.daemon.client.hand import COMMANDS, STREAM, accepted
from softfinger.daemon.client.patience import PATIENCE, SILENCE, answer_to, still_waiting
from softfinger.daemon.client.wire import Decoder, nothing_from, prepare, silent
from softfinger.daemon.errors import HandFault, NoStream, NotInTime
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import load_client
from softfinger.daemon.wire.local_stop import stop_locally
from softfinger.daemon.wire.packer import pack
from softfinger.daemon.wire.schema import Event, HandState, TactileFrame

_log = logging.getLogger(__name__)


class AsyncHand:
    """A hand by its two addresses, in one event loop: ``async with AsyncHand() as hand: …``."""

    def __init__(
        self,
        stream: str = STREAM,
        commands: str = COMMANDS,
        *,
        client: str = "",
        timeout: float = PATIENCE,
        keys: Path | None = None,
    ) -> None:
        self.stream_address = stream
        self.command_address = commands
        self.client = client
        self.timeout = timeout
        self._context = zmq.asyncio.Context()
        if keys is not None:
            load_client(keys).guard(self._context)

    async def __aenter__(self) -> AsyncHand:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._context.destroy(linger=0)

    def stream(self) -> AsyncIterator[HandState]:
        """States one after the other, every one that is published."""
        return self._records(schema.STATE)

    def frames(self) -> AsyncIterator[TactileFrame]:
        """Tactile frames of both fingers."""
        return self._records(schema.TACTILE)

    def events(self) -> AsyncIterator[Event]:
        """What the daemon tells: modes, faults, warnings."""
        return self._records(schema.EVENT)

    async def _records(self, topic: bytes) -> AsyncIterator[Any]:
        decoder = Decoder(topic)
        async with self._socket(zmq.SUB) as socket:
            prepare(socket, self.stream_address, topic)
            while True:
                record = decoder.take(await socket.recv_multipart())
                if record is not None:
                    yield record

    @asynccontextmanager
    async def _socket(self, kind: int) -> AsyncIterator[Any]:
        socket = self._context.socket(kind)
        try:
            yield socket
        finally:
            socket.close(linger=0)

    async def state(self) -> HandState:
        """The next state to come. Raises NoStream."""
        return await self.wait_for(lambda _: True, self.timeout)

    async def wait_for(
        self, condition: Callable[[HandState], object], timeout: float = 10.0
    ) -> HandState:
        """The first state from now on for which ``condition`` holds.

        Raises as `client.hand.Hand.wait_for` does.
        """
        last: HandState | None = None
        states = self.stream()
        told = asyncio.get_running_loop().call_later(
            SILENCE, silent, self.stream_address, schema.STATE, timeout
        )
        try:
            async with asyncio.timeout(timeout):
                async for last in states:
                    told.cancel()
                    if condition(last):
                        return last
                    if last.fault:
                        raise HandFault(last.fault)
        except TimeoutError:
            pass
        finally:
            told.cancel()
            await states.aclose()  # type: ignore[attr-defined]
        if last is None:
            raise NoStream(nothing_from(self.stream_address, schema.STATE, timeout))
        raise NotInTime(f"not within {timeout:g} s; the last state: mode {last.mode}")

    async def command(self, name: str, **numbers: float) -> dict[str, Any]:
        """Send one command and return the reply. Raises Refused with the reason, and NoAnswer."""
        request: dict[str, Any] = {"command": name, **numbers}
        if self.client:
            request["client"] = self.client
        if name == "stop":  # past all other clients, where the daemon is this user's
            stopped = await asyncio.to_thread(
                stop_locally, self.command_address, min(self.timeout, LOCALLY)
            )
            if stopped is not None:
                return accepted(stopped)
        async with self._socket(zmq.REQ) as socket:
            socket.connect(self.command_address)
            await socket.send(pack(request))
            silence = min(SILENCE, self.timeout)
            answered = await socket.poll(silence * 1e3)
            what = answer_to(request, self.command_address)
            if not answered and silence < self.timeout:
                _log.warning(still_waiting(what, self.timeout))
                answered = await socket.poll((self.timeout - silence) * 1e3)
            if not answered:
                raise NoAnswer(f"no {what} within {self.timeout:g} s; is softfinger running?")
            reply = msgpack.unpackb(await socket.recv())
        if not isinstance(reply, dict):
            raise NoAnswer(f"{self.command_address} answered something that is not a reply")
        return accepted(reply)
