"""Faults on demand for the emulated servo bus: what may go wrong with replies and with servos.

Replies are dropped, late, cut, damaged or doubled with given probabilities from a seeded source.
Everything can be set by a word of text, so that a flag and a control socket use the same terms.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, fields

LATE = 0.010  # s that a late reply is late by


class FaultError(ValueError):
    """A fault that can't be understood. The message says what is known."""


@dataclass(slots=True)
class ReplyFaults:
    """Probabilities, 0 … 1, for each reply."""

    drop: float = 0.0  # it never comes
    late: float = 0.0  # it comes LATE seconds later
    truncate: float = 0.0  # its end is missing
    corrupt: float = 0.0  # one bit is flipped
    duplicate: float = 0.0  # it comes twice


REPLY_FAULTS = tuple(field.name for field in fields(ReplyFaults))
SERVO_FAULTS = ("silent", "answer", "reboot", "overheat", "overload", "undervoltage", "recover")


class FaultSource:
    """Applies :class:`ReplyFaults` to replies, the same way for the same seed."""

    def __init__(self, seed: int = 1) -> None:
        self.rates = ReplyFaults()
        self._random = random.Random(seed)

    @property
    def active(self) -> bool:
        """Whether any probability is above 0."""
        rates = self.rates
        return bool(rates.drop or rates.late or rates.truncate or rates.corrupt or rates.duplicate)

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


def parse_fault(text: str) -> tuple[str, float]:
    """``drop=0.01`` or ``overheat=2`` as (kind, number): a probability, or a servo's ID.

    Raises:
        FaultError: unknown kind, no number, a probability outside 0 … 1.
    """
    kind, equals, value = text.strip().partition("=")
    known = REPLY_FAULTS + SERVO_FAULTS
    if kind not in known or not equals:
        raise FaultError(
            f"fault {text!r}: expected KIND=PROBABILITY with {', '.join(REPLY_FAULTS)}, "
            f"or KIND=ID with {', '.join(SERVO_FAULTS)}"
        )
    try:
        number = float(value)
    except ValueError:
        raise FaultError(f"fault {text!r}: {value!r} is not a number") from None
    if kind in REPLY_FAULTS and not 0.0 <= number <= 1.0:
        raise FaultError(f"fault {text!r}: a probability lies in 0 … 1")
    if kind in SERVO_FAULTS and (number != int(number) or not 0 <= number <= 252):
        raise FaultError(f"fault {text!r}: an ID is a whole number in 0 … 252")
    return kind, number
