"""Faults of the emulated hand in words: ``[PART:]KIND[=VALUE][@SECONDS]``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.simulation.servo_model.bus_faults import LINE_FAULTS, SERVO_FAULTS
from softfinger.daemon.types import FINGERS

SERVOS = "servos"
OBJECT = "object"
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
