"""Define the faults of the emulated hand, and parse the words that start these faults.

A fault is written as ``[PART:]KIND[=VALUE][@START[..END]]``. The fault begins suddenly at START, or
increases linearly from START to END. Faults do not change the physics of the hand.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Collection, Iterable
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.types import FINGERS

FloatArray = NDArray[np.float64]

SERVOS = "servos"
OBJECT = "object"
ALL = "all"
LATE_REPLY_DELAY = 0.010  # s


_REPLY_FAULTS = (
    "drop",  # probability that a reply is lost
    "late",  # probability that a reply is delayed by LATE_REPLY_DELAY
    "truncate",  # probability that the end of a reply is missing
    "corrupt",  # probability that one bit of a reply is flipped
    "duplicate",  # probability that a reply is sent twice
    "delay",  # delay of all replies, as with a slow adapter [s]
)
LINE_FAULTS = (
    "lose",  # probability that an instruction is lost
    "lose-writes",  # additional probability of losing an instruction that is not a read
    *_REPLY_FAULTS,
)
_DELAY_MAX = 1.0  # s
_LOAD_MAX = 1e6  # N or N·m; the energies of far larger loads overflow
_SERVO_FAILURES = ("overheat", "overload", "undervoltage", "stuck", "jump", "frozen", "refuse")
SERVO_FAULTS = ("silent", "answer", "reboot", *_SERVO_FAILURES, "recover")
BOARD_FAULTS = {  # default probability of each fault
    "torn": 0.1,
    "noisy": 0.1,
    "silent": 1.0,
    "frozen": 1.0,
    "wrong-size": 1.0,
    "saturated": 1.0,
    "zero": 1.0,
}
_PORT_FAULTS = ("unplug", "plug")
WELL = "well"


class FaultSource:
    """Generator of random line faults that are reproducible for a given seed.

    ``rates`` contains the probability or delay of each of LINE_FAULTS.
    """

    def __init__(self, seed: int = 1) -> None:
        self.rates = dict.fromkeys(LINE_FAULTS, 0.0)
        self._random = random.Random(seed)

    def loses(self, reads: bool) -> bool:
        """Return True if the next instruction is lost; ``reads`` is True for a read instruction."""
        kinds = ("lose",) if reads else ("lose", "lose-writes")
        rates = [self.rates[kind] for kind in kinds]
        return any(rate > 0.0 and self._random.random() < rate for rate in rates)

    def spoil(self, reply: bytes) -> list[tuple[float, bytes]]:
        """Apply faults to a reply and return the bytes to send, each with its extra delay [s]."""
        rates, chance = self.rates, self._random.random
        if not any(rates[kind] for kind in _REPLY_FAULTS):
            return [(0.0, reply)]
        if chance() < rates["drop"]:
            return []
        delay = rates["delay"] + (LATE_REPLY_DELAY if chance() < rates["late"] else 0.0)
        if chance() < rates["truncate"]:
            reply = reply[: self._random.randrange(len(reply))]
        if reply and chance() < rates["corrupt"]:
            bit = self._random.randrange(8 * len(reply))
            damaged = bytearray(reply)
            damaged[bit // 8] ^= 1 << bit % 8
            reply = bytes(damaged)
        copies = 2 if chance() < rates["duplicate"] else 1
        return [(delay, reply)] * copies


REPLAY_TIME_MAX = 3.0  # s


MEASUREMENT_FAULTS = {  # neutral value, minimum and maximum
    "gain": (1.0, 0.0, 100.0),  # factor applied to all pressures
    # Shift of the image towards higher column numbers, in cells. The gap is filled with zeros.
    "shift-x": (0.0, -255.0, 255.0),
    "shift-y": (0.0, -255.0, 255.0),  # shift towards higher row numbers, in cells
    "mirror": (0.0, 0.0, 1.0),  # A value of 1 reverses the column order.
    "drift": (0.0, -1.0, 1.0),  # offset added to all cells, as a fraction of the maximum count
    "replay": (0.0, 0.0, REPLAY_TIME_MAX),  # duration of the repeated sequence [s]
    "current": (1.0, -100.0, 100.0),  # factor applied to the measured current
}
_SWITCHED_FAULTS = ("mirror", "replay")  # faults that are either on or off


class FaultError(SoftfingerError, ValueError):
    """Invalid fault or request. The error message states the reason."""


class FaultEvent(NamedTuple):
    """Start of a fault or of a load on the object."""

    after: float  # s
    part: str  # ``servos``, ``object``, ``all`` or the name of a finger
    kind: str
    value: float = 1.0  # probability, servo ID, load, or value of a measurement fault
    over: float = 0.0  # duration of the linear increase to the full value [s]

    def __str__(self) -> str:
        if self.kind == WELL:
            prefix = "" if self.part == ALL else f"{self.part}: "
            return f"{prefix}all faults have ended"
        value = "" if self.kind in _PORT_FAULTS else f"={self.value:g}"
        over = f" within {self.over:g} s" * bool(self.over)
        return f"fault: {self.part}: {self.kind}{value}{over}"


class _Form(NamedTuple):
    """Group of fault types with the same syntax."""

    kinds: Collection[str]
    value: str  # syntax of the value, in brackets if optional, empty if no value is allowed
    parts: tuple[str, ...]  # affected parts if the word does not name a finger
    sided: bool = False  # True if the word may name a finger
    bounds: tuple[float, float] = (-math.inf, math.inf)  # minimum and maximum value


# The first matching group is used. Therefore, `silent=2` and `frozen=2` are servo faults, but
# `silent` and `left:silent` are board faults.
_ID = "=ID"
_FORMS = (
    _Form(SERVO_FAULTS, _ID, (SERVOS,)),
    _Form(BOARD_FAULTS, "[=PROBABILITY]", FINGERS, sided=True, bounds=(0.0, 1.0)),
    _Form(LINE_FAULTS[:-1], "=PROBABILITY", (SERVOS,), bounds=(0.0, 1.0)),  # without `delay`
    _Form(("delay",), "=SECONDS", (SERVOS,), bounds=(0.0, _DELAY_MAX)),
    _Form(MEASUREMENT_FAULTS, "=NUMBER", FINGERS, sided=True),
    # `push` is a force along the faces, away from the palm [N]. `twist` is a torque [N·m].
    _Form(("push", "twist"), "=NUMBER", (OBJECT,), bounds=(-_LOAD_MAX, _LOAD_MAX)),
    _Form(_PORT_FAULTS, "", (SERVOS,), sided=True),
    _Form((WELL,), "", (ALL,), sided=True),
)
_WORD = re.compile(r"(?:([^:]*):)?([a-z-]+)(?:=([^@]*))?(?:@(.*?)(?:\.\.(.*))?)?")


def parse_faults(words: Iterable[str], ids: tuple[int, ...]) -> list[FaultEvent]:
    """Parse fault words and return the faults in chronological order.

    `softfinger help emulate` lists the words. `TactileBoard` and MEASUREMENT_FAULTS define the
    faults of boards and measurements. Without a prefix, these faults affect both fingers. Faults
    with the same start time stay in the order of their words. ``ids`` are the servo IDs. Raises
    FaultError if a word is invalid.
    """
    events = (event for word in words for event in _parse(word.strip(), ids))
    return sorted(events, key=attrgetter("after"))


def _parse(word: str, ids: tuple[int, ...]) -> list[FaultEvent]:
    def refused(why: str) -> FaultError:
        return FaultError(f"fault {word!r}: {why}")

    match = _WORD.fullmatch(word)
    side, kind, text, start, end = match.groups() if match else (None, "", None, None, None)
    if side is not None and side not in FINGERS:
        raise refused(f"found the prefix '{side}:', expected 'left:' or 'right:'")
    value = None if text is None else _number(text)
    if value is not None and not math.isfinite(value):
        raise refused(f"{text!r} is not a number")
    after = 0.0 if start is None else _number(start)
    if not 0.0 <= after < math.inf:
        raise refused(f"found the start time {start!r}, expected at least 0 s")
    until = after if end is None else _number(end)
    if not after <= until < math.inf:
        raise refused(f"found the end time {end!r}, expected at least {start} s")
    for form in _FORMS:
        has_value = form.value.startswith("[") or (value is not None) == bool(form.value)
        if kind in form.kinds and has_value and (form.sided or side is None):
            break
    else:
        known = (f"{', '.join(each.kinds)} {each.value}".strip() for each in _FORMS)
        raise refused(f"expected one of {'; '.join(known)}")
    if end is not None and (kind not in MEASUREMENT_FAULTS or kind in _SWITCHED_FAULTS):
        raise refused(
            f"{kind} does not change gradually; give a single start time such as @{start}"
        )
    if form.value == _ID and value not in ids:
        raise refused("no servo has this ID")
    if value is None:
        value = BOARD_FAULTS.get(kind, 1.0)
    low, high = MEASUREMENT_FAULTS[kind][1:] if kind in MEASUREMENT_FAULTS else form.bounds
    if not low <= value <= high:
        unit = form.value.strip("[=]").lower()
        raise refused(f"found {value:g}, expected {low:g} to {high:g} ({unit})")
    return [
        FaultEvent(after, part, kind, value, until - after)
        for part in ((side,) if side else form.parts)
    ]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class MeasurementFaults:
    """Measurement faults of one finger's tactile sensor and servo current."""

    def __init__(self) -> None:
        # Initial value, final value, start time [s] and duration [s] of each change.
        self._changes: dict[str, tuple[float, float, float, float]] = {}

    def begin(self, kind: str, value: float, t: float, over: float = 0.0) -> None:
        """Change a measurement fault linearly to ``value`` between ``t`` and ``t + over`` [s].

        The change starts at the fault's value at ``t`` and replaces an unfinished change. Raises
        KeyError if ``kind`` is unknown.
        """
        self._changes[kind] = self(kind, t), value, t, over

    def clear(self) -> None:
        """End all faults immediately."""
        self._changes.clear()

    def __call__(self, kind: str, t: float) -> float:
        """Return the value of a fault at time ``t`` [s]."""
        if kind not in self._changes:
            return MEASUREMENT_FAULTS[kind][0]
        before, after, begin, over = self._changes[kind]
        if t < begin:
            return before
        if t >= begin + over:
            return after
        return before + (after - before) * (t - begin) / over

    def apply(self, signal: FloatArray, full_count: int, t: float) -> None:
        """Apply the faults active at time ``t`` [s] to the sensor signal [rows, cols] in place.

        Shifts by a fraction of a cell are interpolated linearly.
        """
        if not self._changes:
            return
        if self("mirror", t) > 0.0:
            signal[:] = signal[:, ::-1].copy()
        rows, cols = (
            _shift(count, self(kind, t))
            for count, kind in zip(signal.shape, ("shift-y", "shift-x"), strict=True)
        )
        signal[:] = self("gain", t) * (rows @ signal @ cols.T) + self("drift", t) * full_count


def _shift(count: int, cells: float) -> FloatArray:
    """Return the [count, count] matrix that shifts a signal by ``cells`` and interpolates."""
    places = np.arange(count)
    weights: FloatArray = np.maximum(1.0 - np.abs(places[:, None] - places - cells), 0.0)
    return weights
