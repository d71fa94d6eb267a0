"""The 32 × 32 glove-style board: its framing, and the backend that polls one.

At 1,000,000 baud. The host writes ``a``; the board answers with one frame of 2 + 2 · rows · cols
bytes: index + 11, then for each cell, row-major, the high 5 bits + 11 and the low 5 bits + 11, then
a newline (10). No byte but the last can be a newline, so the stream is found again at the next one.
There is no checksum: a byte that turned into another one of 11 … 42 goes unseen.

Boards with a 12-bit converter send the same with 6 bits in each half; ``tactile.full_count`` above
1023, up to 4095, tells them.
"""

from __future__ import annotations

import numpy as np

from softfinger.daemon.tactile.decoder import Decoded, DelimitedDecoder
from softfinger.daemon.tactile.serial_reader import SerialReader

_OFFSET = 11
_BITS = 5  # of each half of a count


class GloveDecoder(DelimitedDecoder):
    """Bytes of a glove-style board in, frames of counts with twice ``bits`` bits out."""

    def __init__(self, rows: int = 32, cols: int = 32, bits: int = _BITS) -> None:
        super().__init__(rows, cols, b"\n", 2 + 2 * rows * cols)
        self._values = 1 << bits  # of each half

    def parse(self, packet: bytearray, t: float) -> Decoded | None:
        if len(packet) != self.longest - 1:
            cells = (len(packet) - 1) // 2
            self._reason = f"lines of {len(packet)} bytes, which is {cells} cells"
            return None
        halves = np.frombuffer(packet, np.uint8, len(packet) - 1, 1) - np.uint8(_OFFSET)
        # Bytes below the offset wrap round to large ones.
        if packet[0] < _OFFSET or halves.max() >= self._values:
            self._reason = "a byte that is no half of a count (tactile.full_count = 4095?)"
            return None
        counts = halves[0::2].astype(np.uint16)
        counts *= self._values
        counts += halves[1::2]
        return Decoded(counts.reshape(self.rows, self.cols), t)


def bits_of(full_count: int) -> int:
    """Return bits in each half of a count, by the largest count of the board."""
    return _BITS + 1 if 1 << 2 * _BITS <= full_count < 1 << 2 * (_BITS + 1) else _BITS


class Glove(SerialReader):
    """The glove-style board under one fingertip, asked for its next frame after each one."""

    request = b"a"

    def make_decoder(self) -> GloveDecoder:
        settings = self.settings
        return GloveDecoder(settings.rows, settings.cols, bits_of(settings.full_count))
