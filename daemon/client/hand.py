"""`Hand`: blocking client for a program or notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from softfinger.daemon.client.command_client import HandClient, accepted, is_done, send
from softfinger.daemon.client.stream import Subscriber, Wait, no_stream
from softfinger.daemon.errors import NoStream, Refused
from softfinger.daemon.wire.schema import EVENT, STATE, TACTILE, Event, HandState, TactileFrame

__all__ = ["Hand", "Subscription"]

_Record = TypeVar("_Record")


class Subscription(Subscriber[_Record]):
    """Iterator over the records of one topic, in order of arrival.

    The subscription begins when the object is created. The iterator raises NoStream if no record
    arrives within ``timeout`` [s]; with None it waits without limit.
    """

    def __iter__(self) -> Iterator[_Record]:
        return self

    def __next__(self) -> _Record:
        return self.next(self._timeout)

    def next(self, timeout: float | None) -> _Record:
        """Return the next record. Raises NoStream if none arrives within ``timeout`` s.

        With a timeout, a warning is logged after a wait of 1 s.
        """
        for milliseconds in self._waits(timeout):
            if self._socket.poll(milliseconds):
                record = self._take(self._socket.recv_multipart())
                if record is not None:
                    return record
        raise no_stream(self._address, self._topic, timeout or 0.0)

    def skip(self) -> None:
        """Drop queued messages, so that the next record is a new one."""
        self._require_open()
        while self._socket.poll(0):
            self._take(self._socket.recv_multipart())

    def __enter__(self) -> Subscription[_Record]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Hand(HandClient[None]):
    """Client of one hand. Create one object in each thread.

    Commands may be sent from any thread. The stream of one object (`state`, `stream`, `frames`,
    `events`, `collect`, `wait_for`) and `close` belong to the first thread that uses the stream,
    until it ends; they raise WrongThread in other threads. All methods raise HandClosed after
    `close`.

    Parameters
    ----------
    stream, commands
        Addresses of the daemon. ``stream`` may also contain both, as ``tcp://HOST`` or
        ``STREAM,COMMANDS``. The default is the environment variable SOFTFINGER_ADDRESS, or else
        this machine.
    client
        Name that owns the command lease.
    timeout
        Time limit for a reply or a first state [s]; 5 s by default.
    keys
        Folder with the keys of this client, if the daemon requires keys.

    Raises
    ------
    SettingsError
        If an address is malformed, or its host is unknown.
    KeyFileError
        If the keys can't be read.
    """

    _states: Subscription[HandState] | None = None

    def __enter__(self) -> Hand:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self, timeout: float | None = None) -> HandState:
        """Wait for a new state and return it; queued states are dropped. Raises NoStream."""
        if self._states is None:
            self._states = self.stream()
        else:
            self._states.skip()
        return self._states.next(self.timeout if timeout is None else timeout)

    def stream(self, timeout: float | None = None) -> Subscription[HandState]:
        """Subscribe to all published states, in order."""
        return self._subscription(STATE, timeout)

    def frames(self, timeout: float | None = None) -> Subscription[TactileFrame]:
        """Subscribe to the tactile frames of both fingers; see `TactileFrame.finger`."""
        return self._subscription(TACTILE, timeout)

    def events(self, timeout: float | None = None) -> Subscription[Event]:
        """Subscribe to the daemon's events: modes, faults, warnings."""
        return self._subscription(EVENT, timeout)

    def _subscription(self, topic: bytes, timeout: float | None) -> Subscription[Any]:
        self._require_open()
        return Subscription(self._context, self.stream_address, topic, timeout, self._thread)

    def collect(self, seconds: float) -> list[HandState]:
        """Return all states of the next ``seconds`` s of the daemon's clock. Raises NoStream."""
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
        """Return the first new state for which ``condition`` holds.

        Raises
        ------
        NotInTime
            If the condition does not hold within ``timeout`` [s].
        HandFault
            If the hand has a fault in a state for which the condition does not hold.
        NoStream
            If no state arrives at all.
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
        """Send one command, without arguments that are None, and return the reply.

        Raises
        ------
        Refused
            If the daemon refuses the command; the message gives the reason.
        NoAnswer
            If no reply arrives in time.
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
