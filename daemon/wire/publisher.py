"""The publisher: messages of the stream, packed and given to the gateway.

A subscriber that comes late, stops reading or dies changes nothing here: the gateway sends to all
of them, and repeats the settings and the last events, with ``again`` true, for late ones. Topics
that nobody subscribes to are not packed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import Frame, HandFacts, Parts, SensorFacts, State, Truth
from softfinger.daemon.wire.loop_link import Link, Topics
from softfinger.daemon.wire.packer import packer
from softfinger.daemon.wire.schema import (
    COMMAND,
    EVENT,
    INPUT,
    SETTINGS,
    STATE,
    STATS,
    TACTILE,
    TOPICS,
    TRUTH,
    Rates,
)

if TYPE_CHECKING:
    from softfinger.daemon.loop.timing import Statistics

_INDEX = {topic: index for index, topic in enumerate(TOPICS)}
GATEWAY_TOPICS = Topics(
    tuple(topic.decode() for topic in TOPICS), settings=_INDEX[SETTINGS], events=_INDEX[EVENT]
)


def bit(topic: bytes) -> int:
    """A topic's bit in `Publisher.wanted`."""
    return 1 << _INDEX[topic]


_COMMANDS = bit(COMMAND)


class Publisher:
    """Publishes state, tactile frames and events. One thread, the loop's, may call it."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._pack = {topic: packer(topic) for topic in TOPICS}
        self._counts = {EVENT: 0, COMMAND: 0, SETTINGS: 0}

    @property
    def wanted(self) -> int:
        """The topics that somebody subscribes to, as bits: see `bit`."""
        return self._link.wanted

    def look(self) -> None:
        """Learn who came and went. The loop does by taking in commands."""
        self._link.look()

    def state(self, state: State, scene: Parts, step: int = 1) -> None:
        """Publish ``hand/state``, every ``step`` ticks."""
        self._send(STATE, state, scene, step)

    def input(self, state: State, frames: tuple[Frame | None, Frame | None]) -> None:
        """Publish ``hand/input``, every tick."""
        self._send(INPUT, state, frames)

    def truth(self, state: State, truth: Truth, step: int = 1) -> None:
        """Publish ``hand/truth``, every ``step`` ticks."""
        self._send(TRUTH, state, truth, step)

    def tactile(
        self,
        frame: Frame,
        data: NDArray[np.uint16],
        finger: int,
        facts: SensorFacts,
        wall: float,
        step: int = 1,
        number: int = 0,
    ) -> None:
        """Publish one finger's frame on ``hand/tactile``; it was sampled at Unix time ``wall``.

        ``data`` [rows, cols] is the frame's, in steps as in ``facts``; one of ``step`` frames is
        sent, and this is the ``number``-th of the sensor.
        """
        self._send(TACTILE, frame, data, finger, facts, wall, step, number)

    def stats(
        self, state: State, period: float, rates: Rates, statistics: Statistics, step: int = 1
    ) -> None:
        """Publish ``hand/stats``, every ``step`` ticks."""
        self._send(STATS, state, period, rates, statistics, step)

    def event(self, wall: float, t: float, level: str, kind: str, text: str) -> None:
        """Publish ``hand/event``."""
        packed = self._pack[EVENT](self._count(EVENT), wall, t, level, kind, text)
        self._link.publish(_INDEX[EVENT], packed, keep=True)

    def command(
        self, wall: float, t: float, tick: int, request: dict[str, Any], error: str
    ) -> None:
        """Publish ``hand/command``; ``error`` is why it was refused, or empty."""
        if self._link.wanted & _COMMANDS:
            self._send(COMMAND, self._count(COMMAND), wall, t, tick, request, error)

    def settings(self, wall: float, t: float, facts: HandFacts) -> None:
        """Publish ``hand/settings``, once."""
        packed = self._pack[SETTINGS](self._count(SETTINGS), wall, t, facts)
        self._link.publish_lasting(_INDEX[SETTINGS], packed)

    def _count(self, topic: bytes) -> int:
        self._counts[topic] += 1
        return self._counts[topic]

    def _send(self, topic: bytes, *arguments: object) -> None:
        self._link.publish(_INDEX[topic], self._pack[topic](*arguments))
