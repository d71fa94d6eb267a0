"""Words of text that say what shall go wrong with the stand-in hand, sorted to its parts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from softfinger.daemon.simulation.emulator.tactile_board import BoardFault
from softfinger.daemon.simulation.servo_model.bus_faults import (
    SERVO_FAULTS,
    FaultError,
    parse_fault,
)
from softfinger.daemon.types import FINGERS

SERVOS = "servos"
_PORT = ("unplug", "plug")
_WELL = "well"


class Event(NamedTuple):
    """What happens to one part of the hand."""

    after: float  # s
    part: str  # ``servos``, ``left`` or ``right``: a board
    what: str | BoardFault  # a board's fault, or words for the part


class Faults:
    """What shall go wrong: sorted from words of text to the servos and to each board.

    - ``torn``, ``noisy``, ``silent``, ``frozen``, ``wrong-size``, ``saturated``, ``zero`` for both
      boards, with ``left:`` or ``right:`` before it for one; see :class:`BoardFault`.
    - ``drop=0.01``, ``silent=2`` … for the servos; see :meth:`ServoBus.fault`.
    - ``unplug`` and ``plug`` for the servos' port, ``left:unplug`` … for a board's.
    - ``well`` ends what is wrong with the servos' line and boards, ``left:well`` with one board.

    ``@SECONDS`` behind it says when it starts. ``events`` has them in time's order, and as they
    were given where they start at once.
    """

    def __init__(self, words: Iterable[str], ids: tuple[int, ...]) -> None:
        """Raises FaultError for a word that can't be understood."""
        events: list[Event] = []
        for word in words:
            events += self._parse(word.strip(), ids)
        self.events = sorted(events, key=lambda event: event.after)

    def _parse(self, word: str, ids: tuple[int, ...]) -> list[Event]:
        side, colon, rest = word.partition(":")
        if colon:
            if side not in FINGERS:
                raise FaultError(f"fault {word!r}: expected left: or right:, found {side}:")
            text, after = _timed(rest)
            if text in (*_PORT, _WELL):
                return [Event(after, side, text)]
            fault = BoardFault.parse(rest)
            return [Event(fault.start, side, fault)]
        kind = word.partition("@")[0].partition("=")[0]
        if kind in BoardFault.KINDS and not word.startswith(tuple(f"{k}=" for k in SERVO_FAULTS)):
            fault = BoardFault.parse(word)
            return [Event(fault.start, name, fault) for name in FINGERS]
        text, after = _timed(word)
        if text == _WELL:
            return [Event(after, name, _WELL) for name in (SERVOS, *FINGERS)]
        if text not in _PORT:
            kind, number = _servo_fault(text)
            if kind in SERVO_FAULTS and number not in ids:
                raise FaultError(f"fault {word!r}: no servo has that ID")
        return [Event(after, SERVOS, text)]


def _timed(word: str) -> tuple[str, float]:
    text, _, start = word.partition("@")
    try:
        after = float(start or "0")
    except ValueError:
        after = math.nan
    if not 0.0 <= after < math.inf:
        raise FaultError(f"fault {word!r}: {start!r} is no time in seconds")
    return text, after


def _servo_fault(text: str) -> tuple[str, float]:
    try:
        return parse_fault(text)
    except FaultError as error:
        boards = ", ".join(BoardFault.KINDS)
        raise FaultError(
            f"{error}; or for tactile boards {boards}; or unplug, plug, well"
        ) from None
