"""Hands in virtual time without hardware: the simulated hand with its daemon, and recordings."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import msgpack

from softfinger.daemon.client.hand import Hand, Subscription
from softfinger.daemon.client.stream import Gaps, no_stream, read
from softfinger.daemon.errors import NoStream, Reason, Refused, SettingsError
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.faults import (
    MEASUREMENT_FAULTS,
    OBJECT,
    WELL,
    FaultError,
    FaultEvent,
    parse_faults,
)
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.command_server import CommandServer
from softfinger.daemon.wire.loop_link import Ask, Link
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, bit, pack, publish
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.processes.compile import build_kernels, print_event
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import RecordingWriter

Controller = Callable[[HandState], Mapping[str, Any] | None]

_QUEUE = 10_000  # maximum number of messages queued for a subscription; the oldest ones are dropped
_ROUNDING = 1e-9  # s
_OWN = b"this process"  # route of this object's own requests
_EVERYTHING = -1  # bit mask of all topics


class RecordingOver(NoStream):
    """Error raised at the end of a recording."""


class Tap(Link):
    """Link that also passes published messages to ``take`` and queues requests from its owner."""

    def __init__(self, take: Callable[[bytes, dict[str, Any]], None]) -> None:
        super().__init__()
        self._take = take
        self.tapped = 0  # bit mask of the topics for `take`
        self.answer: dict[str, Any] = {}  # reply to the owner's last request

    def request(self, request: dict[str, Any], t: float) -> None:
        """Add a request that arrives at time ``t`` [s]; the next tick sets `answer`."""
        urgent = request["command"] == "stop"
        self.asked.append(Ask(t, self.stops, urgent, "", [_OWN], msgpack.packb(request)))

    def look(self) -> bool:
        all_sent = super().look()
        self.wanted |= self.tapped
        return all_sent

    def reply(self, ask: Ask, reply: bytes) -> None:
        if ask.route == [_OWN]:
            self.answer = msgpack.unpackb(reply)
        else:
            super().reply(ask, reply)

    def publish(self, topic: int, message: bytes, keep: int = 0) -> None:
        super().publish(topic, message, keep)
        if self.tapped >> topic & 1:
            self._take(GATEWAY_TOPICS[topic].encode(), msgpack.unpackb(message))

    def kept(self) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield the stored messages: the settings and the last events."""
        for topic, messages in self._kept.items():
            for message in messages:
                yield GATEWAY_TOPICS[topic].encode(), msgpack.unpackb(message)


class VirtualSubscription(Subscription[Any]):
    """Iterator over the records of one topic; waiting for a record advances the virtual time."""

    def __init__(self, hand: VirtualTimeHand, topic: bytes, timeout: float | None) -> None:
        # Do not call the base class's constructor, because it would open a socket.
        self._hand, self._thread, self._address = hand, hand._thread, hand.stream_address
        self._topic, self._timeout = topic, timeout
        self._gaps, self.unreadable = Gaps(), 0
        self._socket = SimpleNamespace(closed=False)
        self.waiting: deque[Any] = deque(maxlen=_QUEUE)

    def add(self, message: dict[str, Any]) -> None:
        """Queue the record of a message; drop the oldest record if the queue is full."""
        try:
            record = read(schema.TOPICS[self._topic].record, message)
        except ValueError:
            self.unreadable += 1
            return
        if self._gaps.take(message):
            self._gaps.lost += len(self.waiting) == _QUEUE
            self.waiting.append(record)

    def next(self, timeout: float | None) -> Any:
        """Return the next record. Raises NoStream after ``timeout`` s of virtual time."""
        self._require_open()
        begin = self._hand.t
        while not self.waiting:
            if timeout is not None and self._hand.t - begin >= timeout:
                raise no_stream(self._address, self._topic, timeout)
            self._hand.step()
        return self.waiting.popleft()

    def __next__(self) -> Any:
        try:
            return self.next(self._timeout)
        except RecordingOver:
            raise StopIteration from None

    def skip(self) -> None:
        """Drop queued records."""
        self._require_open()
        self.waiting.clear()

    def close(self) -> None:
        """End the subscription."""
        self._thread.claim()
        self._socket.closed = True
        self._hand._select_topics()


class VirtualTimeHand(Hand):
    """Base class for hands in virtual time, which advances only during method calls.

    All methods of `softfinger.Hand` work, so a program that uses a `Hand` runs unchanged and waits
    in virtual time. The method `run` is intended for controllers that are functions of the state.
    """

    def __init__(self) -> None:
        self._temporary = TemporaryDirectory(prefix="softfinger-")
        folder = self._temporary.name
        super().__init__(f"ipc://{folder}/stream", f"ipc://{folder}/commands")
        self._link = Tap(self._take)
        self._subscriptions: list[VirtualSubscription] = []
        self._writer: RecordingWriter | None = None
        self._serving = False

    @property
    def t(self) -> float:
        """Virtual time [s]."""
        raise NotImplementedError

    def _now(self) -> float:
        return self.t

    @property
    def address(self) -> str:
        """Address during `serve`, for `Hand` or for the environment variable SOFTFINGER_ADDRESS."""
        return f"{self.stream_address},{self.command_address}"

    def step(self) -> None:
        """Advance by the smallest step: a tick, or a recorded message."""
        self._require_open()
        if self._serving:
            raise RuntimeError(
                "serve() is running and advances the clock itself; instead of this call, use a "
                "client such as Hand(hand.address)"
            )
        self._step()

    def _step(self) -> None:
        raise NotImplementedError

    def run(self, seconds: float, controller: Controller | None = None) -> list[Refused]:
        """Advance by ``seconds``, and carry out the commands of ``controller``, if given.

        Parameters
        ----------
        controller : function that is called with each published state, ``stream.state_rate`` times
            per second, and returns either None or the next command as a map such as
            ``{"command": "hold", "force": 5.0}``

        Returns
        -------
        list[Refused]
            Refusals of the controller's commands. A refusal may be due to an event that occurred
            after the state was published.

        Raises
        ------
        Refused
            If a command is unknown to the daemon or has invalid parameters.
        """
        end, refusals = self.t + seconds - _ROUNDING, []
        states = self._subscription(schema.STATE, None)
        with states, contextlib.suppress(RecordingOver):
            while self.t < end:
                self.step()
                while controller is not None and states.waiting:
                    try:
                        self._command_map(controller(states.waiting.popleft()))
                    except Refused as refusal:
                        if refusal.reason == Reason.REQUEST:
                            raise
                        refusals.append(refusal)
        return refusals

    def _command_map(self, request: Mapping[str, Any] | None) -> None:
        if request is not None:
            if not (isinstance(request, Mapping) and "command" in request):
                raise TypeError(
                    f"controller: found {request!r}, expected None or a map such as "
                    '{"command": "hold", "force": 5.0}'
                )
            numbers = dict(request)
            self.command(numbers.pop("command"), **numbers)

    @contextlib.contextmanager
    def serve(self, speed: float = 1.0) -> Iterator[str]:
        """Serve clients over ZeroMQ; the context manager returns `address`.

        A thread advances virtual time ``speed`` times as fast as real time, or more slowly if the
        machine is slow. Clients in this process are created with ``Hand(hand.address)``.
        """
        config = Config(self.stream_address, self.command_address, GATEWAY_TOPICS, _QUEUE)
        over = threading.Event()

        def advance() -> None:
            begin, first = time.monotonic(), self.t
            with contextlib.suppress(RecordingOver):
                while not over.is_set():
                    self._step()
                    due = begin + (self.t - first) / speed
                    # If this thread falls behind, delay the schedule instead of catching up.
                    begin += max(time.monotonic() - due, 0.0)
                    over.wait(max(due - time.monotonic(), 0.0))

        with contextlib.closing(Gateway(config, self._link)) as gateway:
            gateway.wait()
            with ThreadPoolExecutor(1) as pool:
                advancing = pool.submit(advance)
                self._serving = True
                try:
                    yield self.address
                finally:
                    over.set()
                    self._serving = False
                advancing.result()

    def _subscription(self, topic: bytes, timeout: float | None) -> VirtualSubscription:
        self._require_open()
        made = VirtualSubscription(self, topic, timeout)
        self._subscriptions.append(made)
        self._select_topics()
        return made

    def _select_topics(self) -> None:
        """Select the topics of the open subscriptions, or all topics while recording."""
        self._subscriptions = [each for each in self._subscriptions if not each._socket.closed]
        self._link.tapped = 0 if self._writer is None else _EVERYTHING
        for each in self._subscriptions:
            self._link.tapped |= bit(each._topic)

    def _take(self, topic: bytes, message: dict[str, Any]) -> None:
        for each in self._subscriptions:
            if each._topic == topic:
                each.add(message)
        if self._writer is not None:
            self._writer.add(topic, message)

    def close(self) -> None:
        """End all subscriptions and discard the hand."""
        for each in self._subscriptions:
            each.close()
        super().close()
        self._temporary.cleanup()


class VirtualHand(VirtualTimeHand):
    """Simulated hand and its daemon, which run in virtual time as fast as this machine permits.

    On the same machine, identical calls produce bit-for-bit identical states.

    Parameters
    ----------
    profile : name or file of a profile with a simulated hand; None for the default settings
    changes : settings to change, in the form of ``--set``
    plant : settings, in the same form, that apply only to the simulated hand and not to the daemon

    Attributes
    ----------
    plant : true state of the simulated hand: ``force``, ``d``, ``theta``, ``q`` of both fingers,
        ``object_pose`` and others; see `SimulatedHand`
    settings : settings of the daemon

    Raises
    ------
    SettingsError
        If the settings are invalid or are not those of a simulated hand.
    """

    def __init__(
        self,
        profile: Path | str | None = None,
        changes: Sequence[str] = (),
        plant: Sequence[str] = (),
    ) -> None:
        self.settings = _virtual(profile, changes)
        hand = _virtual(profile, (*changes, *plant)) if plant else None
        build_kernels(self.settings, print_event)
        super().__init__()
        self._daemon = Daemon(self.settings, wire=self._link, hand=hand)
        assert self._daemon.hand is not None
        self.plant: SimulatedHand = self._daemon.hand
        self._faults: list[FaultEvent] = []

    @property
    def t(self) -> float:
        """Virtual time [s]."""
        return self._daemon.clock.now()

    def _step(self) -> None:
        self._apply_faults()
        self._daemon.loop.advance(self._daemon.loop.period)

    def _send(self, request: dict[str, Any]) -> dict[str, Any]:
        self._link.request(request, self.t)
        self.step()
        return self._link.answer

    def fault(self, *words: str) -> None:
        """Start loads and measurement faults such as ``"push=3@0.5"`` or ``"left:gain=0.8"``.

        `softfinger help emulate` lists all faults. Times of faults are relative to the time of this
        call. ``"well"`` ends all faults.

        Raises
        ------
        FaultError
            If a word is unknown, or if a fault requires servos and boards as in `EmulatedHand`.
        """
        events = [(word, event) for word in words for event in parse_faults([word], ())]
        for word, event in events:
            if event.part != OBJECT and event.kind not in (*MEASUREMENT_FAULTS, WELL):
                raise FaultError(
                    f"fault {word!r}: found a servo or board fault, expected a measurement fault "
                    "or a load; emulated_hand supports all faults"
                )
        self._faults += [event._replace(after=event.after + self.t) for _, event in events]
        self._faults.sort(key=lambda event: event.after)
        self._apply_faults()

    def _apply_faults(self) -> None:
        while self._faults and self._faults[0].after <= self.t:
            self.plant.apply_fault(self._faults.pop(0))

    @contextlib.contextmanager
    def record(self, path: Path | str) -> Iterator[None]:
        """Record all topics to a new file until the context ends; requires the extra ``record``.

        Raises RuntimeError if another recording of this hand has not ended.
        """
        if self._writer is not None:
            raise RuntimeError(
                f"record {path}: found a recording in progress, expected none; leave the other "
                "record() context first"
            )
        self._writer = RecordingWriter(Path(path))
        for topic, message in self._link.kept():
            self._writer.add(topic, message)
        self._select_topics()
        try:
            yield
        finally:
            writer, self._writer = self._writer, None
            self._select_topics()
            writer.close()

    def close(self) -> None:
        """Switch the torque off and discard the hand."""
        self._daemon.close()
        super().close()


def _virtual(profile: Path | str | None, changes: Sequence[str]) -> Settings:
    """Load the settings of a simulated hand and select the virtual clock."""
    settings = load(None if profile is None else Path(profile), Path(), changes)
    if not settings.simulated:
        raise SettingsError(
            f"{profile or 'changes'}: found hardware backends, expected simulated backends: use "
            "emulated_hand, which emulates the hardware"
        )
    return settings.changed(loop={"clock": "virtual"})


class RecordedHand(VirtualTimeHand):
    """Recording that behaves like a `Hand` in virtual time; commands have no effect.

    When the recording ends, iteration over a stream stops and `run` returns.

    Parameters
    ----------
    path : a recording; requires the extra ``record``

    Attributes
    ----------
    sent : time [s] and map of each command that was sent

    Raises
    ------
    RecordingError
        If the file is not a recording.
    """

    def __init__(self, path: Path | str) -> None:
        self._recording = Recording(Path(path))
        self._messages = self._recording.messages()
        self._mode: dict[str, Any] = {}
        self._t = 0.0
        super().__init__()
        self._commands = CommandServer(self._link, clock=lambda: self.t)
        self.sent: list[tuple[float, dict[str, Any]]] = []

    @property
    def t(self) -> float:
        """Time since the first message of the recording [s]."""
        return self._t

    def _step(self) -> None:
        found = next(self._messages, None)
        if found is None:
            raise RecordingOver(f"{self._recording.path}: the recording ended after {self.t:.3f} s")
        topic, message = found
        stamp = message.get("timestamp")
        if isinstance(stamp, float) and message.get("again") is not True:
            self._t = max(self._t, stamp - self._recording.start)
        if topic == schema.STATE:
            self._mode = {name: message.get(name) for name in ("mode", "fault", "torque")}
        publish(self._link, topic, pack(message))
        self._commands.serve(self._note)

    def _send(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"ok": True, **self._note(request)}

    def close(self) -> None:
        """Close the recording and discard the hand."""
        super().close()
        self._messages.close()

    def _note(self, request: dict[str, Any], _age: float = 0.0) -> dict[str, Any]:
        if request["command"] != "status":
            self.sent.append((self.t, request))
        return dict(self._mode)
