"""Framings of emulated tactile boards: counts → bytes, as a board's firmware would send them.

They share no code with the decoders, so that each can be tested against the other. (Our own
framing's reference encoder serves here, too.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.tactile import cobs

# counts [rows, cols], the scan's number, the board's time [s] → bytes
Encode = Callable[[NDArray[np.uint16], int, float], bytes]


@dataclass(frozen=True, slots=True)
class Encoder:
    """A framing, and the byte that a board waits for before each frame; empty when it runs free."""

    encode: Encode
    request: bytes = b""


def encode_flexitac(counts: NDArray[np.uint16], _number: int = 0, _t: float = 0.0) -> bytes:
    """``AA 55``, then one byte a cell, row-major; counts above 255 saturate."""
    return b"\xaa\x55" + np.minimum(counts, 255).astype(np.uint8).tobytes()


def encode_glove(
    counts: NDArray[np.uint16], number: int = 0, _t: float = 0.0, values: int = 32
) -> bytes:
    """Number + 11, each count's high and low half + 11, newline; counts beyond that saturate.

    ``values`` of a half: 32 or, with a 12-bit converter, 64.
    """
    counts = np.minimum(counts, values * values - 1)
    halves = np.stack([counts // values + 11, counts % values + 11], axis=-1)
    return bytes((11 + number % 244,)) + halves.astype(np.uint8).tobytes() + b"\n"


def encoder_for(backend: str, full_count: int) -> Encoder:
    """The framing of a backend's board whose largest count is ``full_count``."""
    if backend == "glove" and 1023 < full_count <= 4095:
        return Encoder(partial(encode_glove, values=64), b"a")
    return ENCODERS[backend]


ENCODERS = {
    "flexitac": Encoder(encode_flexitac),
    "glove": Encoder(encode_glove, b"a"),
    "cobs": Encoder(cobs.encode),
}
