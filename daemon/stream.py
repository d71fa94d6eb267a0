"""The publisher: two-frame messages ``[topic, msgpack map]`` on an XPUB socket.

A subscriber that comes late, stops reading or dies changes nothing here: sends never wait, and a
slow subscriber's queue is bounded, beyond which its messages are dropped. Topics that nobody
subscribes to are not packed. Who comes late is told the settings and the last events again, with
``again`` true, one message a tick.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from daemon import messages
from daemon.fixed_maps import InputMap, StateMap
from daemon.records import Frame, State
from daemon.sockets import OWNER_ONLY, Bound, Guard
from daemon.statistics import Statistics

# Plain numbers, since enum flags cost a microsecond.
_NOW, _MORE_NOW = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)
_CHANGES = 16  # subscriptions taken in at a time; more wait for the next look
_KEPT = 50  # events that a late subscriber is told
_TOPICS = (
    messages.STATE,
    messages.TACTILE,
    messages.STATS,
    messages.INPUT,
    messages.TRUTH,
    messages.EVENT,
    messages.COMMAND,
    messages.SETTINGS,
)


class Publisher:
    """Publishes state, tactile frames and events. One thread, the loop's, may call it."""

    def __init__(
        self, context: zmq.Context[Any], address: str, queue: int, guard: Guard = OWNER_ONLY
    ) -> None:
        self._bound = Bound(context, zmq.XPUB, address, "stream.address", queue, 1024, guard)
        self._socket = self._bound.socket
        # Past the conveniences of pyzmq's outer class, which cost more than a send does.
        self._send_frame = super(zmq.Socket, self._socket).send
        self._pack_state, self._pack_input = StateMap(), InputMap()
        self._subscriptions: set[bytes] = set()
        self.wants_state = False
        self.wants_tactile = False
        self.wants_stats = False
        self.wants_input = False
        self.wants_truth = False
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # tells every new subscriber, not a first one
        self._told = {messages.EVENT: 0, messages.COMMAND: 0, messages.SETTINGS: 0}
        self._kept: deque[tuple[bytes, dict[str, Any]]] = deque(maxlen=_KEPT)
        self._settings: list[tuple[bytes, dict[str, Any]]] = []
        self._owed: set[bytes] = set()  # topics to tell again
        self._again: deque[tuple[bytes, dict[str, Any]]] = deque()

    def refresh(self) -> None:
        """Learn who came and went. XPUB tells a topic's first subscriber and its last one gone."""
        for _ in range(_CHANGES):
            if not self._bound.readable():
                break
            change = self._socket.recv(zmq.NOBLOCK)
            # What is the beginning of no topic is not kept: there may be any number of it.
            if change[:1] == b"\x01" and any(each.startswith(change[1:]) for each in _TOPICS):
                self._subscriptions.add(change[1:])
                self._owe(change[1:])
            elif change[:1] == b"\x00":  # else no subscription at all: not every socket is a SUB
                self._subscriptions.discard(change[1:])
        self.wants_state = self._wanted(messages.STATE)
        self.wants_tactile = self._wanted(messages.TACTILE)
        self.wants_stats = self._wanted(messages.STATS)
        self.wants_input = self._wanted(messages.INPUT)
        self.wants_truth = self._wanted(messages.TRUTH)

    def _wanted(self, topic: bytes) -> bool:
        return any(topic.startswith(prefix) for prefix in self._subscriptions)

    def state(self, state: State, scene: messages.Parts, step: int = 1) -> None:
        """Publish ``hand/state``, every ``step`` ticks."""
        self._send_packed(messages.STATE, self._pack_state(state, scene, step))

    def input(self, state: State, frames: tuple[Frame | None, Frame | None]) -> None:
        """Publish ``hand/input``, every tick."""
        self._send_packed(messages.INPUT, self._pack_input(state, frames))

    def truth(self, state: State, truth: messages.Truth, step: int = 1) -> None:
        """Publish ``hand/truth``, every ``step`` ticks."""
        self._send(messages.TRUTH, messages.truth_message(state, truth, step))

    def tactile(
        self,
        frame: Frame,
        data: NDArray[np.uint16],
        finger: int,
        facts: messages.SensorFacts,
        wall: float,
        step: int = 1,
        number: int = 0,
    ) -> None:
        """Publish one finger's frame on ``hand/tactile``, see `daemon.messages.tactile_message`."""
        message = messages.tactile_message(frame, data, finger, facts, wall, step, number)
        self._send(messages.TACTILE, message)

    def stats(
        self,
        state: State,
        period: float,
        rates: messages.Rates,
        statistics: Statistics,
        step: int = 1,
    ) -> None:
        """Publish ``hand/stats``, every ``step`` ticks."""
        message = messages.stats_message(state, period, rates, statistics, step)
        self._send(messages.STATS, message)

    def event(self, wall: float, t: float, level: str, kind: str, text: str) -> None:
        """Publish ``hand/event``."""
        seq = self._count(messages.EVENT)
        message = messages.event_message(seq, wall, t, level, kind, text)
        self._kept.append((messages.EVENT, message))
        self._send(messages.EVENT, message)

    def command(
        self, wall: float, t: float, tick: int, request: dict[str, Any], error: str
    ) -> None:
        """Publish ``hand/command``: what came and what became of it."""
        if self._wanted(messages.COMMAND):
            seq = self._count(messages.COMMAND)
            message = messages.command_message(seq, wall, t, tick, request, error)
            self._send(messages.COMMAND, message)

    def settings(self, wall: float, t: float, facts: messages.Facts) -> None:
        """Publish ``hand/settings``, once."""
        message = messages.settings_message(self._count(messages.SETTINGS), wall, t, facts)
        self._settings = [(messages.SETTINGS, message)]
        self._send(messages.SETTINGS, message)

    def repeat(self) -> None:
        """Send one of the messages that a late subscriber missed, if any is owed."""
        if not self._again:
            if not self._owed:
                return
            held = [*self._settings, *self._kept]
            self._again.extend(each for each in held if each[0] in self._owed)
            self._owed.clear()
            if not self._again:
                return
        topic, message = self._again.popleft()
        self._send(topic, {**message, "again": True})

    def _owe(self, prefix: bytes) -> None:
        # Who comes while a list is being sent is told by the next one: a flood makes no more.
        for topic in (messages.SETTINGS, messages.EVENT):
            if topic.startswith(prefix):
                self._owed.add(topic)

    def _count(self, topic: bytes) -> int:
        self._told[topic] += 1
        return self._told[topic]

    def _send(self, topic: bytes, message: dict[str, Any]) -> None:
        self._send_packed(topic, messages.pack(message))

    def _send_packed(self, topic: bytes, packed: bytes) -> None:
        try:
            self._send_frame(topic, _MORE_NOW)
            self._send_frame(packed, _NOW)
        except zmq.Again:
            pass  # XPUB drops rather than waits; should libzmq ever refuse, the loop goes on

    def close(self) -> None:
        """Send what is queued (for 0.2 s at most) and close."""
        self._bound.close()
