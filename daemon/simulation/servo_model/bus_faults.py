"""Faults of the emulated servo bus: what may go wrong on the line and with servos."""

from __future__ import annotations

import random
from dataclasses import dataclass, fields

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
SERVO_FAULTS = (
    "silent",
    "answer",
    "reboot",
    "overheat",
    "overload",
    "undervoltage",
    "stuck",
    "jump",
    "frozen",
    "refuse",
    "recover",
)


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
