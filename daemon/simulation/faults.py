"""Faults of the emulated hand: in words ``[PART:]KIND[=VALUE][@SECONDS]``, and on the line."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import NamedTuple

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.types import FINGERS

SERVOS = "servos"
OBJECT = "object"
LATE = 0.010  # s that a late reply is late by


@dataclass(slots=True)
class LineFaults:
    """Probabilities, 0 … 1, for each instruction and each reply."""

    lose: float = 0.0  # an instruction reaches no servo
    lose_writes: float = 0.0  # one that asks for no reading reaches none, besides
    drop: float = 0.0  # a reply never comes
    late: float = 0.0  # it comes LATE seconds later
    truncate: float = 0.0  # its end is missing
    corrupt: float = 0.0  # one bit is flipped
    duplicate: float = 0.0  # it comes twice


LINE_FAULTS = tuple(field.name.replace("_", "-") for field in fields(LineFaults))
_AILMENTS = ("overheat", "overload", "undervoltage", "stuck", "jump", "frozen", "refuse")
SERVO_FAULTS = ("silent", "answer", "reboot", *_AILMENTS, "recover")
BOARD_FAULTS = {  # kind → probability if none is given
    "torn": 0.1,
    "noisy": 0.1,
    "silent": 1.0,
    "frozen": 1.0,
    "wrong-size": 1.0,
    "saturated": 1.0,
    "zero": 1.0,
}
_PORT = ("unplug", "plug")
_LOADS = ("push", "twist")  # N along the object's faces, away from the palm; N·m
_WELL = "well"
_WORD = re.compile(r"(?:([^:]*):)?([a-z-]+)(?:=([^@]*))?(?:@(.*))?")


class FaultSource:
    """Applies :class:`LineFaults`, the same way for the same seed."""

    def __init__(self, seed: int = 1) -> None:
        self.rates = LineFaults()
        self._random = random.Random(seed)

    @property
    def active(self) -> bool:
        """Whether anything may happen to replies."""
        rates = self.rates
        return bool(rates.drop or rates.late or rates.truncate or rates.corrupt or rates.duplicate)

    def loses(self, reads: bool) -> bool:
        """Whether the next instruction reaches no servo; ``reads``: it asks for a reading."""
        rates = self.rates
        if rates.lose and self._random.random() < rates.lose:
            return True
        return bool(not reads and rates.lose_writes and self._random.random() < rates.lose_writes)

    def spoil(self, reply: bytes) -> list[tuple[float, bytes]]:
        """What comes of a reply: (extra delay [s], bytes), none when it was dropped."""
        rates, chance = self.rates, self._random.random
        if chance() < rates.drop:
            return []
        delay = LATE if chance() < rates.late else 0.0
        if chance() < rates.truncate:
            reply = reply[: self._random.randrange(len(reply))]
        if reply and chance() < rates.corrupt:
            bit = self._random.randrange(8 * len(reply))
            damaged = bytearray(reply)
            damaged[bit // 8] ^= 1 << bit % 8
            reply = bytes(damaged)
        copies = 2 if chance() < rates.duplicate else 1
        return [(delay, reply)] * copies


class FaultError(SoftfingerError, ValueError):
    """A fault that can't be understood. The message says what is known."""


class FaultEvent(NamedTuple):
    """What happens to one part of the hand."""

    after: float  # s
    part: str  # ``servos``, ``left`` or ``right``: a board
    kind: str
    value: float = 1.0  # a probability, a servo's ID, or a load


def parse_faults(words: Iterable[str], ids: tuple[int, ...]) -> list[FaultEvent]:
    """Faults from words of text, in time's order, and as they were given where they start at once.

    - ``torn``, ``noisy``, ``silent``, ``frozen``, ``wrong-size``, ``saturated``, ``zero`` for both
      boards, with ``left:`` or ``right:`` before it for one; see :class:`TactileBoard`.
    - ``drop=0.01``, ``silent=2`` … for the servos; see :meth:`ServoBus.fault`.
    - ``unplug`` and ``plug`` for the servos' port, ``left:unplug`` … for a board's.
    - ``push=15``, ``twist=0.3`` for the object, from then on; 0 ends it.
    - ``well`` ends what is wrong with the servos' line and boards, ``left:well`` with one board.

    ``@SECONDS`` behind it says when it starts. ``ids`` are the servos'. Raises FaultError for a
    word that can't be understood.
    """
    return sorted((event for word in words for event in _parse(word.strip(), ids)), key=_after)


def _after(event: FaultEvent) -> float:
    return event.after


def _parse(word: str, ids: tuple[int, ...]) -> list[FaultEvent]:
    def refused(why: str) -> FaultError:
        return FaultError(f"fault {word!r}: {why}")

    match = _WORD.fullmatch(word)
    side, kind, text, start = match.groups() if match else (None, "", None, None)
    if side is not None and side not in FINGERS:
        raise refused(f"expected left: or right:, found {side}:")
    after = _number(start) if start is not None else 0.0
    if not 0.0 <= after < math.inf:
        raise refused(f"{start!r} is no time of 0 s or more")
    value = _number(text) if text is not None else None
    if value is not None and math.isnan(value):
        raise refused(f"{text!r} is not a number")
    probability = value is not None and 0.0 <= value <= 1.0
    if kind in _LOADS and side is None and value is not None and math.isfinite(value):
        return [FaultEvent(after, OBJECT, kind, value)]
    if value is None and kind in _PORT:
        return [FaultEvent(after, side or SERVOS, kind)]
    if value is None and kind == _WELL:
        return [FaultEvent(after, part, kind) for part in ((side,) if side else (SERVOS, *FINGERS))]
    # `silent=2` and `frozen=2` are a servo's, `silent` and `left:silent` a board's.
    if kind in BOARD_FAULTS and (side or value is None or kind not in SERVO_FAULTS):
        if value is not None and not probability:
            raise refused("a probability lies in 0 … 1")
        chance = BOARD_FAULTS[kind] if value is None else value
        return [FaultEvent(after, part, kind, chance) for part in ((side,) if side else FINGERS)]
    if value is not None and side is None and kind in LINE_FAULTS:
        if not probability:
            raise refused("a probability lies in 0 … 1")
        return [FaultEvent(after, SERVOS, kind, value)]
    if value is not None and side is None and kind in SERVO_FAULTS:
        if value not in ids:
            raise refused("no servo has that ID")
        return [FaultEvent(after, SERVOS, kind, value)]
    raise refused(
        f"expected for tactile boards {', '.join(BOARD_FAULTS)} [=PROBABILITY]; for the servos "
        f"{', '.join(LINE_FAULTS)} =PROBABILITY or {', '.join(SERVO_FAULTS)} =ID; or "
        f"{', '.join(_LOADS)} =NUMBER; unplug, plug, well"
    )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
