"""The 32 × 32 glove-style board: its framing, and the backend that polls one.

At 1,000,000 baud. The host writes ``a``; the board answers with one frame of 2 + 2 · rows · cols
bytes: index + 11, then for each cell, row-major, the high 5 bits + 11 and the low 5 bits + 11, then
a newline (10). No byte but the last can be a newline, so the stream is found again at the next one.
There is no checksum: a byte that turned into another one of 11 … 42 goes unseen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daemon.clock import Clock
from daemon.settings import TactileSettings
from daemon.tactile.delimited import DelimitedDecoder
from daemon.tactile.serial_reader import SerialReader

REQUEST = b"a"
_NEWLINE = 10
_OFFSET = 11
_HALF = 32  # values of each half of a count
_PATIENCE = 0.1  # s over a frame's time on the wire until the board is asked again


class GloveDecoder(DelimitedDecoder):
    """Bytes of a glove-style board in, frames of 10-bit counts out."""

    def __init__(self, rows: int = 32, cols: int = 32) -> None:
        super().__init__(rows, cols, _NEWLINE, 2 + 2 * rows * cols)
        self._reason = ""

    def parse(self, packet: bytearray) -> NDArray[np.uint16] | None:
        """As :meth:`DelimitedDecoder.parse`."""
        if len(packet) != self.longest - 1:
            cells = (len(packet) - 1) // 2
            self._reason = f"lines of {len(packet)} bytes, which is {cells} cells"
            return None
        halves = np.frombuffer(packet, np.uint8, len(packet) - 1, 1) - np.uint8(_OFFSET)
        # Bytes below the offset wrap round to large ones.
        if packet[0] < _OFFSET or halves.max() >= _HALF:
            self._reason = "a byte that stands for no half of a count"
            return None
        counts = halves[0::2].astype(np.uint16)
        counts *= _HALF
        counts += halves[1::2]
        return counts.reshape(self.rows, self.cols)

    def reason(self) -> str:
        """As :meth:`DelimitedDecoder.reason`."""
        return self._reason


class Glove(SerialReader):
    """The glove-style board under one fingertip, asked for its next frame after each one."""

    def __init__(self, settings: TactileSettings, clock: Clock, finger: int) -> None:
        """``finger`` 0 is the left one; it chooses the port."""

        def make_decoder() -> GloveDecoder:
            return GloveDecoder(settings.rows, settings.cols)

        super().__init__(
            settings.port[finger],
            settings.baud,
            make_decoder,
            clock,
            latency=settings.latency,
            open_timeout=settings.open_timeout,
            request=REQUEST,
            patience=_PATIENCE,
        )
