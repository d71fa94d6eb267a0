"""Read a glove-style board with 32 × 32 cells by polling it over a serial port.

The board runs at 1,000,000 baud. The host writes ``a``, and the board replies with one frame of 2 +
2 · rows · cols bytes. The first byte of a frame is an index, offset by 11. The last byte is a
newline (10). The bytes in between encode the cells in row-major order. The first byte of a cell
contains the high 5 bits of the count, offset by 11. The second byte contains the low 5 bits, with
the same offset. Only the last byte can be a newline, so the decoder resynchronises at the next
newline. A frame has no checksum. A corrupted byte is therefore detected only if its value is
outside the range from 11 to 42.

Boards with a 12-bit converter send 6 bits per half of a count. A ``tactile.full_count`` from 1024
to 4095 selects a 12-bit board.
"""

from __future__ import annotations

import numpy as np

from softfinger.daemon.tactile.decoder import Decoded, DelimitedDecoder
from softfinger.daemon.tactile.serial_reader import SerialReader

_OFFSET = 11


class GloveDecoder(DelimitedDecoder):
    """Decoder for a glove-style board, which sends each count in two halves of ``bits`` bits."""

    def __init__(self, rows: int = 32, cols: int = 32, bits: int = 5) -> None:
        super().__init__(rows, cols, b"\n", 2 + 2 * rows * cols)
        self._values = 1 << bits  # number of possible values per half

    def parse(self, packet: bytearray, t: float) -> Decoded | None:
        if len(packet) != self.longest - 1:
            cells = (len(packet) - 1) // 2
            self._reason = f"lines of {len(packet)} bytes, which correspond to {cells} cells"
            return None
        halves = np.frombuffer(packet, np.uint8, len(packet) - 1, 1) - np.uint8(_OFFSET)
        # In this uint8 subtraction, bytes below the offset wrap around to large values.
        if packet[0] < _OFFSET or halves.max() >= self._values:
            self._reason = (
                "a byte that is not a valid half of a count (set tactile.full_count = 4095 if the "
                "board sends 12-bit counts)"
            )
            return None
        counts = halves[0::2].astype(np.uint16)
        counts *= self._values
        counts += halves[1::2]
        return Decoded(counts.reshape(self.rows, self.cols), t)


def bits_of(full_count: int) -> int:
    """Return the number of bits per half of a count, given the board's maximum count."""
    return 6 if 1024 <= full_count < 4096 else 5


class Glove(SerialReader):
    """Glove-style board under one fingertip. The reader requests each frame separately."""

    request = b"a"

    def make_decoder(self) -> GloveDecoder:
        settings = self.settings
        return GloveDecoder(settings.rows, settings.cols, bits_of(settings.full_count))
