"""Framings whose packets end with a byte that occurs nowhere else: the part that they share.

`DelimitedDecoder` cuts a stream at that byte and counts; what a packet says is its subclass's.
Such a stream is found again after any damage at the next delimiter, and a packet is whole as soon
as its delimiter came, so nothing is ever held back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.tactile.serial_reader import Decoded

_LOST_AFTER = 10  # frames' worth of bytes without a frame


class DelimitedDecoder:
    """Bytes in, frames out, for packets that end with ``delimiter``. Pure and incremental.

    A subclass implements :meth:`parse` and :meth:`reason`. Every byte fed is part of a frame,
    counted in ``skipped_bytes``, or still held; at most ``longest`` bytes are held.
    """

    def __init__(self, rows: int, cols: int, delimiter: int, frame_bytes: int) -> None:
        """``frame_bytes``: a frame on the wire with its delimiter, the longest if lengths vary."""
        self.rows = rows
        self.cols = cols
        self.frame_bytes = frame_bytes
        self.longest = frame_bytes
        self._delimiter = bytes([delimiter])
        self._buffer = bytearray()
        self._scanned = 0  # bytes of the buffer known to hold no delimiter
        self._in_step = False  # the buffer starts where a packet starts
        self._frames = 0
        self._resyncs = 0
        self._skipped = 0
        self._skipped_at_frame = 0

    def parse(self, packet: bytearray) -> NDArray[np.uint16] | None:
        """Fresh counts [rows, cols] of one packet without its delimiter; None if it is no frame."""
        raise NotImplementedError

    def reason(self) -> str:
        """Why the last packet was no frame, in a few words; empty when there was none."""
        raise NotImplementedError

    def decoded(self, counts: NDArray[np.uint16], t: float) -> Decoded:
        """The frame of ``counts`` whose last byte was read at ``t`` [s]."""
        return Decoded(counts, t)

    def feed(self, data: bytes, t: float) -> Decoded | None:
        """Take the next bytes, read at time ``t`` [s]; the newest frame that they completed."""
        buffer = self._buffer
        buffer += data
        newest = None
        behind = 0
        end = buffer.find(self._delimiter, self._scanned)
        while end >= 0:
            packet = buffer[:end]
            del buffer[: end + 1]
            counts = self.parse(packet) if packet else None
            if counts is not None:
                newest = self.decoded(counts, t)
                self._frames += 1
                self.frame_bytes = end + 1
                self._skipped_at_frame = self._skipped
                behind = len(buffer)
            else:
                # Whatever stands before the first delimiter may be a frame's tail.
                self._resyncs += bool(packet) and self._in_step
                self._skipped += end + 1
            self._in_step = True
            end = buffer.find(self._delimiter)
        if len(buffer) > self.longest:
            self._resyncs += self._in_step
            self._in_step = False
            self._skipped += len(buffer)
            buffer.clear()
        self._scanned = len(buffer)
        if newest is not None:
            newest.behind = behind
        return newest

    def settle(self) -> Decoded | None:
        """Nothing ever waits for the line to be quiet."""
        return None

    @property
    def pending(self) -> bool:
        """Always False: a packet is whole with its delimiter."""
        return False

    @property
    def missing(self) -> int:
        """Bytes until the frame in hand is whole; 0 before its first byte and out of step."""
        held = len(self._buffer)
        return max(self.frame_bytes - held, 0) if held and self._in_step and self._frames else 0

    @property
    def lost(self) -> bool:
        """Frames came once, and none within the last ten frames' worth of bytes."""
        behind = self._skipped - self._skipped_at_frame + len(self._buffer)
        return behind > _LOST_AFTER * self.longest

    def counters(self) -> dict[str, int]:
        """``frames``, ``resyncs`` (packets that were no frame), ``skipped_bytes``."""
        return {
            "frames": self._frames,
            "resyncs": self._resyncs,
            "skipped_bytes": self._skipped,
        }

    def diagnosis(self) -> str:
        """What is wrong with a stream that gives no frames, in one line."""
        expected = f"{self.rows} × {self.cols} = {self.rows * self.cols} cells"
        reason = self.reason()
        if reason:
            return f"{reason}; {expected} expected"
        end = self._delimiter.hex().upper()
        return f"no packet that ends with {end} among them; another board or baud?"
