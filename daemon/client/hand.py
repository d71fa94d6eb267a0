"""`Hand`: the hand for a program or a notebook, one thread, plain calls that wait."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from softfinger.daemon.client.command_client import HandClient, accepted, is_done, send
from softfinger.daemon.client.stream import Subscriber, Wait, no_stream
from softfinger.daemon.errors import NoStream, Refused
from softfinger.daemon.wire.schema import EVENT, STATE, TACTILE, Event, HandState, TactileFrame

_Record = TypeVar("_Record")


class Subscription(Subscriber[_Record]):
    """The records of one topic, in order, as they come. Subscribed from its making on.

    ``timeout`` [s] is how long it waits for the next one before it raises NoStream; None: for ever.
    """

    def __iter__(self) -> Iterator[_Record]:
        return self

    def __next__(self) -> _Record:
        return self.next(self._timeout)

    def next(self, timeout: float | None) -> _Record:
        """Return the next record. Raises NoStream when none comes within ``timeout`` s.

        A warning is logged when that takes long; without a timeout, silence may be as it should.
        """
        for milliseconds in self._waits(timeout):
            if self._socket.poll(milliseconds):
                record = self._take(self._socket.recv_multipart())
                if record is not None:
                    return record
        raise no_stream(self._address, self._topic, timeout or 0.0)

    def skip(self) -> None:
        """Drop what waits: the next record is one that is still to come."""
        self._require_open()
        while self._socket.poll(0):
            self._take(self._socket.recv_multipart())

    def __enter__(self) -> Subscription[_Record]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Hand(HandClient[None]):
    """A hand by its two addresses, or by one text as ``tcp://HOST`` or ``STREAM,COMMANDS``.

    Not for use from several threads at once; make one in each.

    The addresses are, unless given, those in the environment variable SOFTFINGER_ADDRESS
    (`client.connection.default_addresses`), or else this machine's. ``client`` is the name that
    owns the commander's lease; ``timeout`` [s] is how long a reply, or a first state, is waited
    for. ``keys`` is the folder of this client's keys, where the daemon wants some; KeyFileError
    when they can't be read. Once closed, everything raises HandClosed.
    """

    _states: Subscription[HandState] | None = None

    def __enter__(self) -> Hand:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self, timeout: float | None = None) -> HandState:
        """Return the next state to come, never one that has been waiting. Raises NoStream."""
        if self._states is None:
            self._states = self.stream()
        else:
            self._states.skip()
        return self._states.next(self.timeout if timeout is None else timeout)

    def stream(self, timeout: float | None = None) -> Subscription[HandState]:
        """Return states one after the other, every one that is published."""
        return self._subscription(STATE, timeout)

    def frames(self, timeout: float | None = None) -> Subscription[TactileFrame]:
        """Tactile frames of both fingers; see `TactileFrame.finger`."""
        return self._subscription(TACTILE, timeout)

    def events(self, timeout: float | None = None) -> Subscription[Event]:
        """Return the daemon's events: modes, faults, warnings."""
        return self._subscription(EVENT, timeout)

    def _subscription(self, topic: bytes, timeout: float | None) -> Subscription[Any]:
        self._require_open()
        return Subscription(self._context, self.stream_address, topic, timeout)

    def collect(self, seconds: float) -> list[HandState]:
        """Return all states of the next ``seconds`` s, by the daemon's clock. Raises NoStream."""
        with self.stream(self.timeout) as states:
            collected = [next(states)]
            end = collected[0].mono_ns + round(seconds * 1e9)
            for state in states:
                if state.mono_ns >= end:
                    break
                collected.append(state)
        return collected

    def wait_for(
        self, condition: Callable[[HandState], object], timeout: float = 10.0
    ) -> HandState:
        """Return the first state from now on for which ``condition`` holds.

        Raises NotInTime after ``timeout`` s, HandFault as soon as the hand has a fault (unless the
        condition holds then), and NoStream when nothing comes at all.
        """
        wait = Wait(condition, timeout)
        with self.stream() as states:
            while True:
                try:
                    state = states.next(wait.left())
                except NoStream:
                    raise wait.over(self.stream_address) from None
                if wait.ends_with(state):
                    return state

    def command(self, name: str, **numbers: float | None) -> dict[str, Any]:
        """Send one command, without numbers that are None, and return the reply.

        Raises Refused with the reason, and NoAnswer.
        """
        request = self._request(name, numbers)
        return accepted(send(self.command_address, request, self.timeout, self._keys))

    def _carry_out(self, command: str, **numbers: float | None) -> None:
        try:
            self.command(command, **numbers)
        except Refused:
            if not is_done(command, self.status()):
                raise

    def status(self) -> dict[str, Any]:
        """Return the daemon's mode, fault, torque, and counters of servos and sensors."""
        return self.command("status")
