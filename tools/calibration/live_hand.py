"""Control a running daemon's hand during a calibration, and store the stream."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, Self

import zmq

from softfinger.daemon.client.connection import REPLY_TIMEOUT, drain, subscribe, unpack
from softfinger.daemon.client.hand import Hand
from softfinger.daemon.client.stream import no_stream, read
from softfinger.daemon.errors import HandFault
from softfinger.daemon.wire.schema import SETTINGS, STATE, TACTILE, HandState
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.tools.arguments import client_keys

_MOST = 1000  # maximum number of messages per read
_WITHIN = 20.0  # time limit for each command, measured on the hand's clock [s]


class LiveHand:
    """Context manager that arms the hand and stores its stream; `messages` works as in `Recording`.

    On exit, the hand is disarmed again if it was disarmed on entry. After an error, the torque is
    switched off.
    """

    path = Path("the stream")

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._address, self._keys = arguments.address, arguments.keys
        self._taken: list[tuple[bytes, dict[str, Any]]] = []
        self._disarm = False
        self._commanded = False  # True once the daemon has accepted a command

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._hand = stack.enter_context(Hand(*self._address, keys=self._keys))
            context = stack.enter_context(zmq.Context())
            if (keys := client_keys(self._keys)) is not None:
                keys.guard(context)
            self._socket = subscribe(context, self._address[0], SETTINGS, STATE, TACTILE)
            stack.push(self._leave)
            mode = next(self.states()).mode
            if mode not in ("disarmed", "armed"):
                raise CalibrationError(f"found mode {mode}, expected disarmed or armed")
            if mode == "disarmed":
                self.command("arm")
                self._disarm = True
            self.until(lambda state: state.mode == "armed" and state.torque)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def _leave(self, kind: type[BaseException] | None, *_: object) -> None:
        self._socket.close()
        if kind is not None and self._commanded:
            self._hand.stop()
        elif self._disarm:
            self._hand.disarm()

    def command(self, name: str, **numbers: float) -> None:
        """Send a command. Raises Refused or NoAnswer."""
        self._hand.command(name, **numbers)
        self._commanded = True

    def states(self) -> Iterator[HandState]:
        """Store all messages and repeatedly yield the newest state. Raises NoStream."""
        while True:
            if not self._socket.poll(int(1e3 * REPLY_TIMEOUT)):
                raise no_stream(self._address[0], STATE, REPLY_TIMEOUT)
            newest = None
            for frames in drain(self._socket, _MOST):
                with contextlib.suppress(ValueError):  # Skip invalid messages.
                    topic, message = unpack(frames)
                    self._taken.append((topic, message))
                    newest = message if topic == STATE else newest
            if newest is not None:
                state = read(HandState, newest)
                if state.fault:
                    raise HandFault(state.fault)
                yield state

    def until(self, holds: Callable[[HandState], object]) -> None:
        """Wait until ``holds(state)`` is true; raise CalibrationError after 20 s."""
        begin = None
        for state in self.states():
            if holds(state):
                return
            begin = begin or state.mono_ns
            if (state.mono_ns - begin) * 1e-9 > _WITHIN:
                raise CalibrationError(f"the hand is still {state.mode} after {_WITHIN:g} s")

    def wait(self, seconds: float) -> None:
        """Wait for ``seconds``, measured on the hand's clock."""
        end = next(self.states()).mono_ns + int(1e9 * seconds)
        self.until(lambda state: state.mono_ns >= end)

    def messages(
        self, topics: Collection[bytes] | None = None
    ) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield the stored messages on ``topics`` in the order of arrival."""
        for topic, message in self._taken:
            if topics is None or topic in topics:
                yield topic, message
