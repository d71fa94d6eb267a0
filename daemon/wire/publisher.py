"""The publisher: messages of the stream, packed and given to the gateway.

A subscriber that comes late, stops reading or dies changes nothing here: the gateway sends to all
of them, and repeats the settings and the last events, with ``again`` true, for late ones. Topics
that nobody subscribes to are not packed.
"""

from __future__ import annotations

from typing import Any

from softfinger.daemon.types import HandFacts
from softfinger.daemon.wire.loop_link import Link, Topics
from softfinger.daemon.wire.packer import packer
from softfinger.daemon.wire.schema import COMMAND, EVENT, SETTINGS, TOPICS

_INDEX = {topic: index for index, topic in enumerate(TOPICS)}
GATEWAY_TOPICS = Topics(
    tuple(topic.decode() for topic in TOPICS), settings=_INDEX[SETTINGS], events=_INDEX[EVENT]
)


def bit(topic: bytes) -> int:
    """Return a topic's bit in `Publisher.wanted`."""
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

    def send(self, topic: bytes, *arguments: object) -> None:
        """Publish a message made from the topic's arguments, as `wire.schema` declares them."""
        self._link.publish(_INDEX[topic], self._pack[topic](*arguments))

    def event(self, wall: float, t: float, level: str, kind: str, text: str) -> None:
        """Publish ``hand/event``."""
        packed = self._pack[EVENT](self._count(EVENT), wall, t, level, kind, text)
        self._link.publish(_INDEX[EVENT], packed, keep=True)

    def command(
        self, wall: float, t: float, tick: int, request: dict[str, Any], error: str
    ) -> None:
        """Publish ``hand/command``; ``error`` is why it was refused, or empty."""
        if self._link.wanted & _COMMANDS:
            self.send(COMMAND, self._count(COMMAND), wall, t, tick, request, error)

    def settings(self, wall: float, t: float, facts: HandFacts) -> None:
        """Publish ``hand/settings``, once."""
        packed = self._pack[SETTINGS](self._count(SETTINGS), wall, t, facts)
        self._link.publish_lasting(_INDEX[SETTINGS], packed)

    def _count(self, topic: bytes) -> int:
        self._counts[topic] += 1
        return self._counts[topic]
