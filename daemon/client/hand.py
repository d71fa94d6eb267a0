"""`Hand`: the hand for a program or a notebook, one thread, plain calls that wait."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar

import zmq

from softfinger.daemon.client.command_client import send
from softfinger.daemon.client.patience import PATIENCE, SILENCE
from softfinger.daemon.client.wire import Decoder, nothing_from, prepare, silent
from softfinger.daemon.errors import HandFault, NoStream, NotInTime, Refused
from softfinger.daemon.profile.settings import CommandSettings, Stream
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import load_client
from softfinger.daemon.wire.schema import Event, HandState, TactileFrame

_Record = TypeVar("_Record")

STREAM = Stream().address
COMMANDS = CommandSettings().address


class Subscription(Generic[_Record]):
    """The records of one topic, in order, as they come. Subscribed from its making on.

    ``timeout`` [s] is how long it waits for the next one before it raises NoStream; None: for ever.
    """

    def __init__(
        self, context: zmq.Context[Any], address: str, topic: bytes, timeout: float | None
    ) -> None:
        self._address = address
        self._topic = topic
        self._timeout = timeout
        self._decoder = Decoder(topic)
        self._socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        prepare(self._socket, address, topic)

    def __iter__(self) -> Iterator[_Record]:
        return self

    def __next__(self) -> _Record:
        return self.next(self._timeout)

    def next(self, timeout: float | None) -> _Record:
        """The next record. Raises NoStream when none comes within ``timeout`` s.

        A warning is logged when that takes long; without a timeout, silence may be as it should.
        """
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while True:
            left = max(deadline - time.monotonic(), 0.0)
            come = self._poll(min(left, SILENCE) if timeout is not None else left)
            if not come and timeout is not None and left > SILENCE:
                silent(self._address, self._topic, timeout)
                come = self._poll(left - SILENCE)
            if not come:
                raise NoStream(nothing_from(self._address, self._topic, timeout or 0.0))
            record: _Record | None = self._decoder.take(self._socket.recv_multipart())
            if record is not None:
                return record

    def _poll(self, seconds: float) -> int:
        return self._socket.poll(math.ceil(seconds * 1e3) if seconds < math.inf else None)

    def skip(self) -> None:
        """Drop what waits: the next record is one that is still to come."""
        while self._socket.poll(0):
            self._decoder.take(self._socket.recv_multipart())

    @property
    def lost(self) -> int:
        """Messages that never arrived, by the gaps in their ``seq``."""
        return self._decoder.gaps.lost

    @property
    def unreadable(self) -> int:
        """Messages that could not be read, and were passed over."""
        return self._decoder.unreadable

    def close(self) -> None:
        """Unsubscribe."""
        self._socket.close()

    def __enter__(self) -> Subscription[_Record]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Hand:
    """A hand by its two addresses. Not for use from several threads at once; make one in each.

    ``client`` is the name that owns the commander's lease (`loop.requests.Lease`); ``timeout`` [s]
    is how long a reply, or a first state, is waited for. ``keys`` is the folder of this client's
    keys, where the daemon wants some; `wire.keys.KeyFileError` when they can't be read.
    """

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
        self._keys = None if keys is None else load_client(keys)
        self._context: zmq.Context[Any] = zmq.Context()
        if self._keys is not None:
            self._keys.guard(self._context)
        self._states: Subscription[HandState] | None = None

    def __enter__(self) -> Hand:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all sockets, those of open subscriptions included. The hand stays as it is."""
        self._context.destroy(linger=0)

    # What the hand says

    def state(self, timeout: float | None = None) -> HandState:
        """The next state to come, never one that has been waiting. Raises NoStream."""
        if self._states is None:
            self._states = self.stream()
        else:
            self._states.skip()
        return self._states.next(self.timeout if timeout is None else timeout)

    def stream(self, timeout: float | None = None) -> Subscription[HandState]:
        """States one after the other, every one that is published."""
        return Subscription(self._context, self.stream_address, schema.STATE, timeout)

    def frames(self, timeout: float | None = None) -> Subscription[TactileFrame]:
        """Tactile frames of both fingers; `TactileFrame.finger` tells whose."""
        return Subscription(self._context, self.stream_address, schema.TACTILE, timeout)

    def events(self, timeout: float | None = None) -> Subscription[Event]:
        """What the daemon tells: modes, faults, warnings."""
        return Subscription(self._context, self.stream_address, schema.EVENT, timeout)

    def collect(self, seconds: float) -> list[HandState]:
        """All states of the next ``seconds`` s, by the daemon's clock. Raises NoStream."""
        with self.stream(self.timeout) as states:
            first = next(states)
            collected = [first]
            end = first.mono_ns + round(seconds * 1e9)
            for state in states:
                if state.mono_ns >= end:
                    break
                collected.append(state)
        return collected

    def wait_for(
        self, condition: Callable[[HandState], object], timeout: float = 10.0
    ) -> HandState:
        """The first state from now on for which ``condition`` holds.

        Raises NotInTime after ``timeout`` s, HandFault as soon as the hand has a fault (unless the
        condition holds then), and NoStream when nothing comes at all.
        """
        deadline = time.monotonic() + timeout
        state: HandState | None = None
        with self.stream() as states:
            while True:
                left = deadline - time.monotonic()
                if state is not None and left <= 0.0:
                    raise NotInTime(_late(state, timeout))
                try:
                    state = states.next(max(left, 0.0))
                except NoStream:
                    if state is not None:
                        raise NotInTime(_late(state, timeout)) from None
                    raise NoStream(
                        nothing_from(self.stream_address, schema.STATE, timeout)
                    ) from None
                if condition(state):
                    return state
                if state.fault:
                    raise HandFault(state.fault)

    # What it is told

    def command(self, name: str, **numbers: float) -> dict[str, Any]:
        """Send one command and return the reply. Raises Refused with the reason, and NoAnswer."""
        request: dict[str, Any] = {"command": name, **numbers}
        if self.client:
            request["client"] = self.client
        return accepted(send(self.command_address, request, self.timeout, self._keys))

    def arm(self) -> None:
        """Torque on; the joints hold where they are."""
        self.command("arm")

    def disarm(self) -> None:
        """Torque off."""
        self.command("disarm")

    def tare(self) -> None:
        """Take what the sensors read now as unloaded."""
        self.command("tare")

    def move(self, left: float | None = None, right: float | None = None) -> None:
        """Joints to angles [rad]."""
        wanted = {"left": left, "right": right}
        self.command("move", **{key: value for key, value in wanted.items() if value is not None})

    def grasp(self, force: float | None = None) -> None:
        """Close, and press with ``force`` [N] on each tip; the settings' force when None."""
        self.command("grasp", **({} if force is None else {"force": force}))

    def rotate(self, angle: float) -> None:
        """Turn the grasped object to ``angle`` [rad] in the hand's frame."""
        self.command("rotate", angle=angle)

    def release(self) -> None:
        """Open."""
        self.command("release")

    def set(self, **numbers: float) -> None:
        """Change a property of the grip, as ``compliance`` [rad/(N·m)]."""
        self.command("set", **numbers)

    def stop(self) -> None:
        """Torque off at once, in every state."""
        self.command("stop")

    def clear(self) -> None:
        """Clear a latched fault, once its cause is gone."""
        self.command("clear")

    def status(self) -> dict[str, Any]:
        """The daemon's own account: fault, torque, counters of servos and sensors."""
        return self.command("status")


def accepted(reply: dict[str, Any]) -> dict[str, Any]:
    """The reply without ``ok``. Raises Refused with the reason when it is not ok."""
    if reply.get("ok") is not True:
        raise Refused(str(reply.get("error", "refused without a reason")))
    return {key: value for key, value in reply.items() if key != "ok"}


def _late(state: HandState, timeout: float) -> str:
    return f"not within {timeout:g} s; the last state: mode {state.mode}, tick {state.seq}"
