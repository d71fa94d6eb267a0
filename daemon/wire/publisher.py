"""The publisher: messages of the stream, packed and given to the gateway.

A subscriber that comes late, stops reading or dies changes nothing here: the gateway sends to all
of them. Topics that nobody subscribes to are not packed. Late subscribers are told the settings and
the last events again, with ``again`` true, by the gateway.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.gateway.config import Topics
from softfinger.daemon.gateway.link import Link
from softfinger.daemon.loop.timing import Statistics
from softfinger.daemon.types import Frame, State
from softfinger.daemon.wire import messages
from softfinger.daemon.wire.packer import InputMap, StateMap

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
_INDEX = {topic: index for index, topic in enumerate(_TOPICS)}
TOPICS = Topics(
    tuple(topic.decode() for topic in _TOPICS), _INDEX[messages.SETTINGS], _INDEX[messages.EVENT]
)


def bit(topic: bytes) -> int:
    """A topic's bit in `Publisher.wanted`."""
    return 1 << _INDEX[topic]


_COMMANDS = bit(messages.COMMAND)


class Publisher:
    """Publishes state, tactile frames and events. One thread, the loop's, may call it."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._pack_state, self._pack_input = StateMap(), InputMap()
        self._told = {messages.EVENT: 0, messages.COMMAND: 0, messages.SETTINGS: 0}

    @property
    def wanted(self) -> int:
        """The topics that somebody subscribes to, as bits: see `bit`."""
        return self._link.wanted

    def look(self) -> None:
        """Learn who came and went. The loop does by taking in commands."""
        self._link.look()

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
        """Publish one finger's frame on ``hand/tactile``, see `wire.messages.tactile_message`."""
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
        self._send(messages.EVENT, message)

    def command(
        self, wall: float, t: float, tick: int, request: dict[str, Any], error: str
    ) -> None:
        """Publish ``hand/command``: what came and what became of it."""
        if self._link.wanted & _COMMANDS:
            seq = self._count(messages.COMMAND)
            message = messages.command_message(seq, wall, t, tick, request, error)
            self._send(messages.COMMAND, message)

    def settings(self, wall: float, t: float, facts: messages.Facts) -> None:
        """Publish ``hand/settings``, once."""
        message = messages.settings_message(self._count(messages.SETTINGS), wall, t, facts)
        self._send(messages.SETTINGS, message)

    def _count(self, topic: bytes) -> int:
        self._told[topic] += 1
        return self._told[topic]

    def _send(self, topic: bytes, message: dict[str, Any]) -> None:
        self._send_packed(topic, messages.pack(message))

    def _send_packed(self, topic: bytes, packed: bytes) -> None:
        if topic == messages.SETTINGS:
            self._link.publish_lasting(_INDEX[topic], packed)
        else:
            self._link.publish(_INDEX[topic], packed, keep=topic == messages.EVENT)
