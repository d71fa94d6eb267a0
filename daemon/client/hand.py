"""Provide `Hand`, a blocking client for programs and notebooks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Self, TypeVar

from softfinger.daemon.client.command_client import IS_DONE, HandClient, NoAnswer, accepted, send
from softfinger.daemon.client.stream import Subscriber, Wait, no_stream
from softfinger.daemon.errors import NoStream, Refused
from softfinger.daemon.wire.schema import EVENT, STATE, TACTILE, Event, HandState, TactileFrame

_Record = TypeVar("_Record")


class Subscription(Subscriber[_Record]):
    """Iterator over the records of one topic, in order of arrival.

    The subscription begins when the object is created. The iterator raises NoStream if no record
    arrives within ``timeout`` [s]. If ``timeout`` is None, the iterator waits indefinitely.
    """

    def __iter__(self) -> Iterator[_Record]:
        return self

    def __next__(self) -> _Record:
        return self.next(self._timeout)

    def next(self, timeout: float | None) -> _Record:
        """Return the next record; raise NoStream if no record arrives within ``timeout`` s.

        If ``timeout`` is a number, a warning is logged after 1 s without a record.
        """
        for milliseconds in self._waits(timeout):
            if self._socket.poll(milliseconds):
                record = self._take(self._socket.recv_multipart())
                if record is not None:
                    return record
        raise no_stream(self._address, self._topic, timeout or 0.0)

    def skip(self) -> None:
        """Drop queued messages so that `next` returns a new record."""
        self._require_open()
        while self._socket.poll(0):
            self._take(self._socket.recv_multipart())

    def __enter__(self) -> Subscription[_Record]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Hand(HandClient[None]):
    """Client for one hand. Create a separate `Hand` in each thread.

    Commands may be sent from any thread. The methods `state`, `stream`, `frames`, `events`,
    `collect` and `wait_for` read the stream. The first thread that calls one of these methods owns
    the stream until the thread ends. In other threads, these methods and `close` raise WrongThread.
    All methods raise HandClosed after `close`.

    Parameters
    ----------
    stream, commands
        Addresses of the daemon. Give both, or give one string for both in ``stream``, as
        ``tcp://HOST`` or ``STREAM,COMMANDS``. By default, the addresses are read from the
        SOFTFINGER_ADDRESS environment variable. If the variable is not set, the addresses refer to
        this machine.
    client
        Client name for the command lease.
    timeout
        Time limit for a reply or for the first state [s]; 5 s by default.
    keys
        Folder with this client's keys, if the daemon requires keys.

    Raises
    ------
    SettingsError
        If an address is malformed, its host is unknown, or one of two addresses is missing.
    KeyFileError
        If the keys can't be read.
    """

    _states: Subscription[HandState] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self, timeout: float | None = None) -> HandState:
        """Drop queued states, then wait for a new state and return it. Raises NoStream."""
        if self._states is None:
            self._states = self.stream()
        else:
            self._states.skip()
        return self._states.next(self.timeout if timeout is None else timeout)

    def stream(self, timeout: float | None = None) -> Subscription[HandState]:
        """Subscribe to all states that the daemon publishes."""
        return self._subscription(STATE, timeout)

    def frames(self, timeout: float | None = None) -> Subscription[TactileFrame]:
        """Subscribe to both fingers' tactile frames; `TactileFrame.finger` is the finger's name."""
        return self._subscription(TACTILE, timeout)

    def events(self, timeout: float | None = None) -> Subscription[Event]:
        """Subscribe to the daemon's events, such as mode changes, faults and warnings."""
        return self._subscription(EVENT, timeout)

    def _subscription(self, topic: bytes, timeout: float | None) -> Subscription[Any]:
        self._require_open()
        return Subscription(self._context, self.stream_address, topic, timeout, self._thread)

    def collect(self, seconds: float) -> list[HandState]:
        """Collect all states for ``seconds``, timed by the daemon's clock. Raises NoStream."""
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
        """Wait for a new state that satisfies ``condition``, and return it.

        Raises
        ------
        NotInTime
            If no state satisfies the condition within ``timeout`` [s].
        HandFault
            If the hand has a latched fault and its state does not satisfy the condition.
        NoStream
            If no state arrives.
        """
        wait = Wait(condition, timeout, self._now)
        with self.stream() as states:
            while True:
                try:
                    state = states.next(wait.left())
                except NoStream:
                    raise wait.over(self.stream_address) from None
                if wait.ends_with(state):
                    return state

    def command(self, name: str, **numbers: float | None) -> dict[str, Any]:
        """Send one command and return the reply. Arguments with the value None are not sent.

        Raises
        ------
        Refused
            If the daemon refuses the command. The message gives the reason.
        NoAnswer
            If the reply does not arrive in time.
        """
        return accepted(self._send(self._request(name, numbers)))

    def _send(self, request: dict[str, Any]) -> dict[str, Any]:
        return send(self.command_address, request, self.timeout, self._keys)

    def _carry_out(self, command: str, **numbers: float | None) -> None:
        try:
            self.command(command, **numbers)
        except Refused:
            if command in IS_DONE:
                with suppress(NoAnswer, Refused):
                    if IS_DONE[command](self.status()):
                        return
            raise

    def status(self) -> dict[str, Any]:
        """Return the mode, the fault, the torque state, and the servo and sensor counters."""
        return self.command("status")
