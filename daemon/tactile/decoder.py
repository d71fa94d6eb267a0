"""Define the interface and the shared code of decoders, which convert serial bytes to frames.

A decoder processes bytes as they arrive, without a port, a clock or a thread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Decoded", "DelimitedDecoder"]

_LOST_AFTER = 10  # number of frame lengths without a frame after which the stream is lost


@dataclass(slots=True)
class Decoded:
    """Decoded frame, with a new array of counts [rows, cols] and the last byte's read time [s]."""

    data: NDArray[np.uint16]
    t: float
    steps: int = 1  # increase in the board's sequence number since the previous frame
    t_sensor: float | None = None  # board clock at mid-scan [s]
    behind: int = 0  # number of bytes that follow the frame in the same read


class Decoder(ABC):
    """Converter from bytes to frames [rows, cols].

    Every received byte belongs to a frame, is counted in ``skipped_bytes``, or is still buffered.
    ``frame_bytes`` is the wire length of a frame or, if lengths vary, of the last frame.
    """

    def __init__(self, rows: int, cols: int, frame_bytes: int) -> None:
        self.rows = rows
        self.cols = cols
        self.frame_bytes = frame_bytes
        self.locked = False  # True if the buffer begins at the start of a frame
        self._buffer = bytearray()
        self._frames = 0
        self._resyncs = 0
        self._skipped = 0
        self._skipped_at_frame = 0

    @abstractmethod
    def feed(self, data: bytes, t: float) -> Decoded | None:
        """Add bytes read at time ``t`` [s]; return the newest completed frame, or None."""

    @abstractmethod
    def diagnosis(self) -> str:
        """Return a one-line explanation of why the decoder finds no frames in the stream."""

    @property
    def pending(self) -> bool:
        """True if ``settle`` might return a complete but unconfirmed frame."""
        return False

    def settle(self) -> Decoded | None:
        """Return the pending frame, or None.

        The reader calls this method when bytes stop arriving.
        """
        return None

    @property
    def missing(self) -> int:
        """Number of bytes missing from the frame in the buffer; 0 if unknown."""
        held = len(self._buffer)
        return max(self.frame_bytes - held, 0) if self.locked and held else 0

    @property
    def lost(self) -> bool:
        """True if the decoder has found no frame in the last ten frame lengths of data."""
        behind = self._skipped - self._skipped_at_frame + len(self._buffer)
        return behind > _LOST_AFTER * self.frame_bytes

    def counters(self) -> dict[str, int]:
        """Return counts: ``frames``, ``resyncs`` (synchronisation losses), ``skipped_bytes``, …"""
        return {
            "frames": self._frames,
            "resyncs": self._resyncs,
            "skipped_bytes": self._skipped,
        }

    def _grid(self) -> str:
        return f"{self.rows} × {self.cols} = {self.rows * self.cols} cells"


class DelimitedDecoder(Decoder):
    """Decoder for packets that end with a delimiter byte, which occurs nowhere else.

    After any corruption, the decoder resynchronises at the next packet. The buffer never exceeds
    the length of the longest packet.
    """

    def __init__(self, rows: int, cols: int, delimiter: bytes, longest: int) -> None:
        """Create a decoder.

        ``longest`` is the maximum wire size of a frame [bytes], including the delimiter.
        """
        super().__init__(rows, cols, longest)
        self.longest = longest
        self._delimiter = delimiter
        # Number of buffered bytes that have already been searched for a delimiter.
        self._scanned = 0
        self._reason = ""  # short reason why the last packet was rejected

    @abstractmethod
    def parse(self, packet: bytearray, t: float) -> Decoded | None:
        """Parse a packet without its delimiter; on failure, set ``_reason`` and return None.

        ``t`` [s] is the read time of the packet's last byte.
        """

    def feed(self, data: bytes, t: float) -> Decoded | None:
        buffer = self._buffer
        buffer += data
        newest = None
        end = buffer.find(self._delimiter, self._scanned)
        while end >= 0:
            packet = buffer[:end]
            del buffer[: end + 1]
            decoded = self.parse(packet, t) if packet else None
            if decoded is not None:
                newest = decoded
                newest.behind = len(buffer)
                self._frames += 1
                self.frame_bytes = end + 1
                self._skipped_at_frame = self._skipped
            else:
                # Bytes before the first delimiter may be the end of an incomplete frame.
                self._resyncs += bool(packet) and self.locked
                self._skipped += end + 1
            self.locked = True
            end = buffer.find(self._delimiter)
        if len(buffer) > self.longest:
            self._resyncs += self.locked
            self.locked = False
            self._skipped += len(buffer)
            buffer.clear()
        self._scanned = len(buffer)
        return newest

    def diagnosis(self) -> str:
        if self._reason:
            return f"found {self._reason}, expected {self._grid()}"
        end = self._delimiter.hex().upper()
        return f"found no packet that ends with {end}; check the board and its baud rate"
