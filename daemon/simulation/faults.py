"""Faults of the emulated hand: ``[PART:]KIND[=VALUE][@START[..END]]`` in words, on the line, and in
what is measured, at once or more and more; the hand itself is as it was.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.types import FINGERS

FloatArray = NDArray[np.float64]

SERVOS = "servos"
OBJECT = "object"
LATE = 0.010  # s that a late reply is late by


@dataclass(slots=True)
class LineFaults:
    """Probabilities, 0 … 1, for each instruction and each reply, and the delay of every reply."""

    lose: float = 0.0  # an instruction reaches no servo
    lose_writes: float = 0.0  # one that asks for no reading reaches none, besides
    drop: float = 0.0  # a reply never comes
    late: float = 0.0  # it comes LATE seconds later
    truncate: float = 0.0  # its end is missing
    corrupt: float = 0.0  # one bit is flipped
    duplicate: float = 0.0  # it comes twice
    delay: float = 0.0  # s that every reply comes later, as behind a slow adapter


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
_UNVALUED = ("unplug", "plug", "well")


class FaultSource:
    """Applies :class:`LineFaults`, the same way for the same seed."""

    def __init__(self, seed: int = 1) -> None:
        self.rates = LineFaults()
        self._random = random.Random(seed)

    @property
    def active(self) -> bool:
        """True if replies may be lost, damaged or delayed."""
        rates = self.rates
        damage = rates.drop or rates.late or rates.truncate or rates.corrupt or rates.duplicate
        return bool(damage or rates.delay)

    def loses(self, reads: bool) -> bool:
        """Draw whether the next instruction reaches no servo; ``reads``: it asks for a reading."""
        rates = self.rates
        if rates.lose and self._random.random() < rates.lose:
            return True
        return bool(not reads and rates.lose_writes and self._random.random() < rates.lose_writes)

    def spoil(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Return (extra delay [s], bytes) of a spoilt reply, none when it was dropped."""
        rates, chance = self.rates, self._random.random
        if chance() < rates.drop:
            return []
        delay = rates.delay + (LATE if chance() < rates.late else 0.0)
        if chance() < rates.truncate:
            reply = reply[: self._random.randrange(len(reply))]
        if reply and chance() < rates.corrupt:
            bit = self._random.randrange(8 * len(reply))
            damaged = bytearray(reply)
            damaged[bit // 8] ^= 1 << bit % 8
            reply = bytes(damaged)
        copies = 2 if chance() < rates.duplicate else 1
        return [(delay, reply)] * copies


LONGEST_REPLAY = 3.0  # s


class MeasurementFault(NamedTuple):
    """A kind: its value where nothing is wrong, and the bounds of its value."""

    honest: float
    low: float
    high: float


MEASUREMENT_FAULTS = {
    "gain": MeasurementFault(1.0, 0.0, 100.0),  # each cell reads so many times its pressure
    "shift-x": MeasurementFault(0.0, -255.0, 255.0),  # cells, towards higher columns; zeros follow
    "shift-y": MeasurementFault(0.0, -255.0, 255.0),  # and towards higher rows
    "mirror": MeasurementFault(0.0, 0.0, 1.0),  # 1: the columns are in reverse order
    "drift": MeasurementFault(0.0, -1.0, 1.0),  # share of the largest count that each cell gains
    "replay": MeasurementFault(0.0, 0.0, LONGEST_REPLAY),  # s of frames that come again and again
    "current": MeasurementFault(1.0, -100.0, 100.0),  # the servo reads so many times its current
}
SUDDEN = ("mirror", "replay")  # have nothing between off and on


class FaultError(SoftfingerError, ValueError):
    """A fault that can't be understood. The message says what is known."""


class FaultEvent(NamedTuple):
    """Fault or load of one device or object at an instant."""

    after: float  # s
    part: str  # ``servos``, ``object``, or a finger: its board, or what it measures
    kind: str
    value: float = 1.0  # a probability, a servo's ID, a load, or a measurement's error
    over: float = 0.0  # s in which it comes

    def __str__(self) -> str:
        value = "" if self.kind in _UNVALUED else f"={self.value:g}"
        return f"{self.part}: {self.kind}{value}" + f" within {self.over:g} s" * bool(self.over)


class _Form(NamedTuple):
    """Kinds of faults that are written alike."""

    kinds: Collection[str]
    value: str  # how a value is written: in brackets where there may be none, empty for no value
    parts: tuple[str, ...]  # what it happens to where the word names no finger
    sided: bool = False  # a finger may be named

    def fits(self, side: str | None, kind: str, valued: bool) -> bool:
        """Return whether a word may be of this form."""
        optional = self.value.startswith("[")
        return (
            kind in self.kinds
            and (self.sided or side is None)
            and (optional or valued == bool(self.value))
        )

    def bounds(self, kind: str) -> tuple[float, float]:
        """Return the least and the greatest value."""
        if kind in MEASUREMENT_FAULTS:
            return MEASUREMENT_FAULTS[kind][1:]
        return (0.0, 1.0) if "PROBABILITY" in self.value else (-math.inf, math.inf)


# The first that fits: `silent=2` and `frozen=2` are a servo's, `left:silent` and `silent` boards'.
_ID = "=ID"
_FORMS = (
    _Form(SERVO_FAULTS, _ID, (SERVOS,)),
    _Form(BOARD_FAULTS, "[=PROBABILITY]", FINGERS, sided=True),
    _Form(LINE_FAULTS, "=PROBABILITY", (SERVOS,)),
    _Form(MEASUREMENT_FAULTS, "=NUMBER", FINGERS, sided=True),
    _Form(("push", "twist"), "=NUMBER", (OBJECT,)),  # N along its faces, away from the palm; N·m
    _Form(_UNVALUED[:2], "", (SERVOS,), sided=True),
    _Form(_UNVALUED[2:], "", (SERVOS, *FINGERS), sided=True),
)
_WORD = re.compile(r"(?:([^:]*):)?([a-z-]+)(?:=([^@]*))?(?:@(.*?)(?:\.\.(.*))?)?")


def parse_faults(words: Iterable[str], ids: tuple[int, ...]) -> list[FaultEvent]:
    """Parse faults from words of text, in time's order, then in the given one.

    - ``torn``, ``noisy``, ``silent``, ``frozen``, ``wrong-size``, ``saturated``, ``zero`` for both
      boards, with ``left:`` or ``right:`` before it for one; see :class:`TactileBoard`.
    - ``drop=0.01``, ``silent=2`` … for the servos; see :meth:`ServoBus.fault`.
    - ``gain=0.5``, ``left:current=2`` … for what both fingers or one measure; see
      MEASUREMENT_FAULTS.
    - ``unplug`` and ``plug`` for the servos' port, ``left:unplug`` … for a board's.
    - ``push=15``, ``twist=0.3`` for the object, from then on; 0 ends it.
    - ``well`` ends what is wrong with the servos' line, boards and measurements, ``left:well`` with
      one finger's.

    ``@START`` behind it says when it starts [s]; ``@START..END`` that a measurement goes wrong
    evenly from then to then. ``ids`` are the servos'. Raises FaultError for a word that can't be
    understood.
    """
    return sorted((event for word in words for event in _parse(word.strip(), ids)), key=_after)


def _after(event: FaultEvent) -> float:
    return event.after


def _parse(word: str, ids: tuple[int, ...]) -> list[FaultEvent]:
    def refused(why: str) -> FaultError:
        return FaultError(f"fault {word!r}: {why}")

    match = _WORD.fullmatch(word)
    side, kind, text, start, end = match.groups() if match else (None, "", None, None, None)
    if side is not None and side not in FINGERS:
        raise refused(f"expected left: or right:, found {side}:")
    value = None if text is None else _number(text)
    if value is not None and not math.isfinite(value):
        raise refused(f"{text!r} is not a number")
    after = 0.0 if start is None else _number(start)
    if not 0.0 <= after < math.inf:
        raise refused(f"{start!r} is no time of 0 s or more")
    until = after if end is None else _number(end)
    if not after <= until < math.inf:
        raise refused(f"{end!r} is no time of {start} s or more")
    form = next((each for each in _FORMS if each.fits(side, kind, value is not None)), None)
    if form is None:
        known = (f"{', '.join(each.kinds)} {each.value}".strip() for each in _FORMS)
        raise refused(f"expected one of {'; '.join(known)}")
    if end is not None and (kind not in MEASUREMENT_FAULTS or kind in SUDDEN):
        raise refused(f"{kind} comes at once, at {start}")
    if form.value == _ID and value not in ids:
        raise refused("no servo has that ID")
    if value is None:
        value = BOARD_FAULTS.get(kind, 1.0)
    low, high = form.bounds(kind)
    if not low <= value <= high:
        raise refused(f"a {form.value.strip('[=]').lower()} lies in {low:g} … {high:g}")
    return [
        FaultEvent(after, part, kind, value, until - after)
        for part in ((side,) if side else form.parts)
    ]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


@dataclass(slots=True)
class _Ramp:
    """A value that changes evenly from one to another."""

    before: float
    after: float
    begin: float  # s
    over: float  # s

    def __call__(self, t: float) -> float:
        if t < self.begin:
            return self.before
        if t >= self.begin + self.over:
            return self.after
        return self.before + (self.after - self.before) * (t - self.begin) / self.over


class MeasurementFaults:
    """Faults of one finger's tactile sensor and of its servo's present current."""

    def __init__(self) -> None:
        self._ramps: dict[str, _Ramp] = {}

    def begin(self, kind: str, value: float, t: float, over: float = 0.0) -> None:
        """Let a kind of MEASUREMENT_FAULTS go to ``value`` from ``t`` on, evenly in ``over`` [s].

        It starts from what it is at ``t``, and takes the place of a change that has not ended then.
        Raises KeyError for another kind.
        """
        self._ramps[kind] = _Ramp(self(kind, t), value, t, over)

    def clear(self) -> None:
        """End all of them at once."""
        self._ramps.clear()

    def __call__(self, kind: str, t: float) -> float:
        """The value of a kind at time ``t`` [s]."""
        ramp = self._ramps.get(kind)
        return MEASUREMENT_FAULTS[kind].honest if ramp is None else ramp(t)

    def apply(self, signal: FloatArray, full_count: int, t: float) -> None:
        """Change a sensor's counts ``signal`` [rows, cols] in place, as it reads them at ``t`` [s].

        Between whole cells a shifted image is interpolated.
        """
        if not self._ramps:
            return
        if self("mirror", t) > 0.0:
            signal[:] = signal[:, ::-1].copy()
        rows, cols = (
            _shift(count, self(kind, t))
            for count, kind in zip(signal.shape, ("shift-y", "shift-x"), strict=True)
        )
        signal[:] = self("gain", t) * (rows @ signal @ cols.T) + self("drift", t) * full_count


def _shift(count: int, cells: float) -> FloatArray:
    """Return the matrix [count, count] that shifts ``count`` values by so many cells, linearly."""
    places = np.arange(count)
    weights: FloatArray = np.maximum(1.0 - np.abs(places[:, None] - places - cells), 0.0)
    return weights
