"""Fuzz the package with random or mutated input; `python -m tests.fuzz` can run for hours."""

import random
from typing import NamedTuple


class Report(NamedTuple):
    """Result of a fuzz run: the number of processed inputs, and the errors found."""

    through: int
    wrong: list[str]
    foreign: int = 0


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Return ``data`` with some or many bytes changed, removed, duplicated or inserted."""
    made = bytearray(data)
    for _ in range(rng.choice((0, 1, 1, 2, 5, 20))):
        kind = rng.randrange(8)
        at = rng.randrange(len(made) + 1)
        if kind == 0 and made:
            made[at % len(made)] = rng.randrange(256)
        elif kind == 1 and made:
            made[at % len(made)] ^= 1 << rng.randrange(8)
        elif kind == 2:
            del made[at : at + rng.randrange(1, 9)]
        elif kind == 3:
            made[at:at] = rng.randbytes(rng.randrange(1, 30))
        elif kind == 4:
            made[at:at] = made[at : at + rng.randrange(1, 40)]
        elif kind == 5:
            del made[at:]
        elif kind == 6:  # Insert a byte that is a delimiter in one of the packet formats.
            made.insert(at, rng.choice((0, 1, 10, 11, 42, 43, 0x55, 0xAA, 0xFD, 254, 255)))
        elif rng.random() < 0.02:
            made[at:at] = rng.randbytes(1) * rng.choice((100, 5000, 20_000))
    return bytes(made)
