"""Decoders from a serial board's bytes to frames: the interface of framings and their common code.

A decoder is pure and incremental: no port, no clock, no thread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LOST_AFTER = 10  # frames' worth of bytes without a frame


@dataclass(slots=True)
class Decoded:
    """A decoded frame: fresh counts [rows, cols] and the time of its last byte [s]."""

    data: NDArray[np.uint16]
    t: float
    steps: int = 1  # frames since the last one by the board's own number
    t_sensor: float | None = None  # the board's clock at the middle of the scan [s]
    behind: int = 0  # bytes that came after its last one in the same read


class Decoder(ABC):
    """Bytes in, frames [rows, cols] out.

    Every byte fed is part of a frame, counted in ``skipped_bytes``, or still in the buffer.
    ``frame_bytes`` is a frame's length on the wire; the last one's where lengths vary.
    """

    def __init__(self, rows: int, cols: int, frame_bytes: int) -> None:
        self.rows = rows
        self.cols = cols
        self.frame_bytes = frame_bytes
        self.locked = False  # the buffer starts where a frame starts
        self._buffer = bytearray()
        self._frames = 0
        self._resyncs = 0
        self._skipped = 0
        self._skipped_at_frame = 0

    @abstractmethod
    def feed(self, data: bytes, t: float) -> Decoded | None:
        """Take the next bytes, read at time ``t`` [s]; the newest frame they completed, if any."""

    @abstractmethod
    def diagnosis(self) -> str:
        """Return what is wrong with a stream that gives no frames, in one line."""

    @property
    def pending(self) -> bool:
        """True if ``settle`` may yield a frame: a whole one waits for the bytes after it."""
        return False

    def settle(self) -> Decoded | None:
        """Return the pending frame, once the line has been quiet since the last byte."""
        return None

    @property
    def missing(self) -> int:
        """Bytes until the frame in the buffer is whole; 0 when that is unknown."""
        held = len(self._buffer)
        return max(self.frame_bytes - held, 0) if self.locked and held else 0

    @property
    def lost(self) -> bool:
        """No frame within the last ten frames' worth of bytes."""
        behind = self._skipped - self._skipped_at_frame + len(self._buffer)
        return behind > _LOST_AFTER * self.frame_bytes

    def counters(self) -> dict[str, int]:
        """Return ``frames``, ``resyncs`` (lost synchronisations), ``skipped_bytes``, and others."""
        return {
            "frames": self._frames,
            "resyncs": self._resyncs,
            "skipped_bytes": self._skipped,
        }

    def _grid(self) -> str:
        return f"{self.rows} × {self.cols} = {self.rows * self.cols} cells"


class DelimitedDecoder(Decoder):
    """Frames in packets that end with a byte which occurs nowhere else.

    A packet is whole with its delimiter, and after any damage the next one is in step again. At
    most the longest packet is buffered.
    """

    def __init__(self, rows: int, cols: int, delimiter: bytes, longest: int) -> None:
        """``longest``: bytes of a frame on the wire at most, with its delimiter."""
        super().__init__(rows, cols, longest)
        self.longest = longest
        self._delimiter = delimiter
        self._scanned = 0  # bytes of the buffer known to hold no delimiter
        self._reason = ""  # why the last packet was no frame, in a few words

    @abstractmethod
    def parse(self, packet: bytearray, t: float) -> Decoded | None:
        """Return the frame of a packet without its delimiter; None, with ``_reason`` set, if none.

        ``t`` [s] is when its last byte was read.
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
                # Whatever stands before the first delimiter may be a frame's tail.
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
            return f"{self._reason}; {self._grid()} expected"
        end = self._delimiter.hex().upper()
        return f"no packet that ends with {end} among them; another board or baud?"
