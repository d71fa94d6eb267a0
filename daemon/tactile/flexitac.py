"""Read FlexiTac boards over a serial port.

The boards send at 2,000,000 baud. Each frame consists of the marker ``AA 55`` and rows × cols
bytes, one byte per count in row-major order. A frame contains no length, sequence number or
checksum. The bytes ``AA 55`` may also occur among the counts.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from itertools import combinations
from typing import Literal

import numpy as np

from softfinger.daemon.tactile.decoder import Decoded, Decoder
from softfinger.daemon.tactile.serial_reader import BITS_PER_BYTE, SerialReader

MARKER = b"\xaa\x55"
_SEARCH_FRAME_COUNT = 12  # number of frames that a search compares before it drops the oldest frame
_SAMPLE_SIZE = 1 << 19  # bytes of an unreadable stream from which the grid size is estimated
_MARKER_COUNT_MAX = 96  # maximum number of markers in the sample that are compared
_GAP_TIME = 1e-3  # minimum gap between frames [s]
_CELL_COUNT_MIN = 16  # minimum number of cells between two markers


class FlexiTacDecoder(Decoder):
    """Decoder for FlexiTac streams.

    *Lock.* A marker can be distinguished from two counts ``AA 55`` only by its position. The search
    requires two markers at a distance of one frame. If another ``AA 55`` between the markers also
    recurs one frame later, the search waits for more frames. The search ends when only one possible
    position remains. The decoder can't lock onto a constant image that contains ``AA 55``, and
    counts the failed search as ``ambiguous``.

    *Hold.* After locking, the decoder returns a frame when it finds the next marker at the expected
    position. The marker proves that no byte of the frame was lost. On a line with gaps between
    frames, waiting for the next marker would delay every frame by one period. After a gap, the
    decoder therefore returns a frame immediately if two conditions rule out a mixture of two
    frames. The bytes must have arrived within their transmission time, and the counts must not
    contain ``AA 55``. All other frames are returned at the next marker or by ``settle``.

    *Loss.* If a marker is not at its expected position, the preceding frame is dropped, and the
    search restarts.
    """

    def __init__(self, rows: int, cols: int, byte_time: float = 5e-6) -> None:
        """Create a decoder; ``byte_time`` is the transmission time of one byte [s]."""
        super().__init__(rows, cols, len(MARKER) + rows * cols)
        self._longest = 1.25 * self.frame_bytes * byte_time + _GAP_TIME  # [s]
        self._t_whole = -math.inf  # time at which the last returned frame was complete
        self._start = 0  # stream position of the buffer's first byte
        # Stream position of the end, and read time [s], of each buffered piece.
        self._pieces: deque[tuple[int, float]] = deque()
        self._ambiguous = 0
        self._sample = bytearray()  # newest bytes received while not locked

    def feed(self, data: bytes, t: float) -> Decoded | None:
        self._buffer += data
        self._pieces.append((self._start + len(self._buffer), t))
        if not self.locked:
            self._sample += data
            del self._sample[:-_SAMPLE_SIZE]
        newest = None
        while self.locked or self._search():
            if self._misplaced(0) or self._misplaced(self.frame_bytes):
                self._lose()
            elif len(self._buffer) >= self.frame_bytes + len(MARKER):
                newest = self._take()
            else:
                break
        if self.pending and self._in_one_go() and not self._may_be_spliced():
            newest = self._take()
        return newest

    def settle(self) -> Decoded | None:
        """Return the pending frame, or None if its counts may contain a marker."""
        return self._take() if self.pending and not self._may_be_spliced() else None

    @property
    def pending(self) -> bool:
        return self.locked and len(self._buffer) >= self.frame_bytes

    @property
    def found_cells(self) -> int:
        """Number of cells per frame, based on the most common marker spacing; 0 while locked."""
        markers = [found.start() for found in re.finditer(MARKER, self._sample)]
        apart = Counter(b - a for a, b in combinations(markers[-_MARKER_COUNT_MAX:], 2))
        spacings = [each for each in apart if each >= _CELL_COUNT_MIN + len(MARKER)]
        spacing = max(spacings, key=lambda each: (apart[each], -each), default=0)
        return spacing - len(MARKER) if apart[spacing] > 2 and spacing != self.frame_bytes else 0

    def counters(self) -> dict[str, int]:
        """Return the common counters and ``ambiguous`` (number of searches without a result)."""
        return {**super().counters(), "ambiguous": self._ambiguous}

    def diagnosis(self) -> str:
        expected = self._grid()
        found = self.found_cells
        if found:
            side = round(found**0.5)
            shape = f"{found} cells" + (f" ({side} × {side} if square)" if side**2 == found else "")
            return (
                f"found frames of {shape}, expected {expected}: set tactile.rows and tactile.cols"
            )
        if self._ambiguous:
            return (
                f"found the AA 55 marker several times in each frame of {expected}, so the frame "
                "boundary is ambiguous: load the sensor differently"
            )
        if MARKER in self._sample:
            return (
                f"found AA 55 markers, but not at the intervals expected for frames of {expected}"
            )
        return (
            f"found no AA 55 marker, expected frames of {expected}: check the board and its baud "
            "rate"
        )

    def _search(self) -> bool:
        """Move the buffer start to a confirmed marker; return False if more bytes are needed."""
        buffer, stride = self._buffer, self.frame_bytes
        while True:
            marker = buffer.find(MARKER)
            if marker < 0:
                self._skip(len(buffer) - buffer.endswith(MARKER[:1]))
                return False
            self._skip(marker)
            verdict = self._only_place()
            if verdict == "undecided":
                return False
            if verdict == "yes":
                self.locked = True
                self._sample.clear()
                return True
            if verdict == "no":
                self._skip(len(MARKER))
                continue
            self._ambiguous += 1
            self._skip(stride)

    def _only_place(self) -> Literal["yes", "no", "undecided", "ambiguous"]:
        """Check whether only the marker at the start of the buffer recurs in every frame.

        Each level of the search adds one frame. The result therefore does not depend on how the
        stream is split into reads.
        """
        buffer, stride = self._buffer, self.frame_bytes
        between = re.finditer(MARKER, buffer[len(MARKER) : stride])
        rivals = [len(MARKER) + found.start() for found in between]
        for level in range(1, _SEARCH_FRAME_COUNT + 1):
            here = level * stride
            if len(buffer) < here + len(MARKER):
                return "undecided"
            if not buffer.startswith(MARKER, here):
                return "no"
            if rivals and len(buffer) < here + rivals[-1] + len(MARKER):
                return "undecided"
            rivals = [rival for rival in rivals if buffer.startswith(MARKER, here + rival)]
            if not rivals:
                return "yes"
        return "ambiguous"

    def _misplaced(self, marker: int) -> bool:
        """Return True if the buffered bytes at position ``marker`` can't be a marker."""
        return not MARKER.startswith(self._buffer[marker : marker + len(MARKER)])

    def _may_be_spliced(self) -> bool:
        """Return True if the frame at the buffer start may contain another frame's marker."""
        first, end = len(MARKER), self.frame_bytes
        # The last count and the byte after the frame may also form a marker.
        return self._buffer.find(MARKER, first) >= 0 or self._buffer.endswith(
            MARKER[:1], first, end
        )

    def _in_one_go(self) -> bool:
        """Return True if the first buffered frame arrived after a gap and without interruption."""
        first, whole = self._pieces[0][1], self._pieces[-1][1]
        return first - self._t_whole > _GAP_TIME and whole - first < self._longest

    def _take(self) -> Decoded:
        count = self.rows * self.cols
        data = np.frombuffer(self._buffer, np.uint8, count, len(MARKER)).astype(np.uint16)
        end = self._start + self.frame_bytes
        read_to, self._t_whole = next(piece for piece in self._pieces if piece[0] >= end)
        self._drop(self.frame_bytes)
        self._frames += 1
        self._skipped_at_frame = self._skipped
        return Decoded(data.reshape(self.rows, self.cols), self._t_whole, behind=read_to - end)

    def _lose(self) -> None:
        self.locked = False
        self._resyncs += 1
        self._sample += self._buffer
        if self._buffer.startswith(MARKER):  # The marker belongs to an incomplete frame.
            self._skip(len(MARKER))

    def _skip(self, count: int) -> None:
        if count:
            self._drop(count)
            self._skipped += count

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._start += count
        while self._pieces and self._pieces[0][0] <= self._start:
            self._pieces.popleft()


class FlexiTac(SerialReader):
    """FlexiTac board under one fingertip."""

    def make_decoder(self) -> FlexiTacDecoder:
        settings = self.settings
        return FlexiTacDecoder(settings.rows, settings.cols, BITS_PER_BYTE / settings.baud)
