"""Read boards with COBS framing, a format for custom boards and for sensors of 44 × 44 cells.

Any baud rate is allowed. A USB board may ignore the baud rate, but ``tactile.baud`` must then be
the actual transfer rate (10 bits per byte), because the reader subtracts the transfer time of each
frame from its arrival time. The board clock needs a quartz: if it is more than 200 ppm slower than
the computer's clock, the frame times become increasingly too early.

The firmware sends each scan without a request, in four steps:

1. Build the message with all numbers in little-endian order:

   ======  ====== =====================================================================
   offset  type   content
   ======  ====== =====================================================================
   0       uint8  bytes per count: 1 (uint8 counts) or 2 (uint16 counts)
   1       uint8  0, reserved
   2       uint16 sequence number, incremented by every scan (sent or not), 0 after 65535
   4       uint32 board clock at mid-scan [µs], wraps at 2³²
   8       uint16 rows
   10      uint16 cols
   12      …      rows × cols counts, row by row
   ======  ====== =====================================================================

2. Append the CRC-16 of the message, low byte first. The CRC type is CRC-16/IBM-3740 (CCITT-FALSE):
   polynomial 0x1021, initial value 0xFFFF, highest bit first, no inversion. The CRC of "123456789"
   is 0x29B1. To compute the CRC::

       crc = 0xFFFF
       for each byte:  crc ^= byte << 8
                       eight times:  crc = (crc << 1) ^ (crc & 0x8000 ? 0x1021 : 0)   in 16 bits

3. Encode the message with COBS, which removes all zero bytes. Split the message at its zero bytes
   and drop the zero bytes. Before each piece, write one byte, which is the length of the piece plus
   one. Split pieces of 254 bytes or more into blocks of 254 bytes, each preceded by the byte 255.
   Send the rest of the piece, which may be empty, as a separate piece. An empty piece at the end of
   the message may be omitted.

4. Send a zero byte. An additional zero byte before the first frame is allowed.

A 44 × 44 frame of uint16 counts takes at most 3903 bytes on the wire. `encode` is the reference
implementation. A reader that starts in the middle of a frame synchronises at the next zero byte.
Incomplete and corrupted frames are dropped. The CRC detects every error that is confined to 16
adjacent bits. Of all other errors, the CRC misses 1 in 65536. The sequence numbers show how many
frames were missed.
"""

from __future__ import annotations

import binascii
import struct

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.tactile.decoder import Decoded, DelimitedDecoder
from softfinger.daemon.tactile.serial_reader import SerialReader
from softfinger.kinematics.compiled.kernel import kernel

_HEADER = struct.Struct("<BBHIHH")
_CRC = struct.Struct("<H")
_CRC_START = 0xFFFF
_TICK = 1e-6  # duration of one tick of the board clock [s]
_BLOCK = 254  # maximum length of a COBS block [bytes]


def encode(counts: NDArray[np.uint8] | NDArray[np.uint16], seq: int, t: float) -> bytes:
    """Encode a frame with counts [rows, cols], a sequence number and the board time ``t`` [s].

    Raises ValueError if the counts are not an array [rows, cols] of uint8 or uint16.
    """
    if counts.dtype not in (np.uint8, np.uint16) or counts.ndim != 2:
        raise ValueError(f"counts must be uint8 or uint16 [rows, cols], got {counts.dtype}")
    ticks = round(t / _TICK) & 0xFFFFFFFF
    kind = counts.dtype.itemsize
    message = _HEADER.pack(kind, 0, seq & 0xFFFF, ticks, *counts.shape)
    message += counts.astype(f"<u{kind}").tobytes()
    message += _CRC.pack(binascii.crc_hqx(message, _CRC_START))
    blocks = (
        piece[k : k + _BLOCK]
        for piece in message.split(b"\0")
        for k in range(0, len(piece) + 1, _BLOCK)
    )
    return b"".join(bytes((len(block) + 1,)) + block for block in blocks) + b"\0"


def longest_frame(rows: int, cols: int) -> int:
    """Return the maximum wire size [bytes] of a uint16 frame, including the delimiter."""
    message = _HEADER.size + 2 * rows * cols + _CRC.size
    return message + 1 + message // _BLOCK + 1


@kernel
def unstuff(packet: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Decode the COBS ``packet`` and write the message to ``out``.

    The packet must not contain zero bytes, and ``out`` must be as long as the packet. Returns the
    message length, or -1 if the packet ends within a block. The code has no data-dependent
    branches, because the processor would often mispredict them.
    """
    code = np.int64(_BLOCK + 1)  # code of the current block
    left = np.int64(0)  # number of bytes that remain in the block
    size = 0
    for byte in packet:
        value = np.int64(byte)
        inside = left > 0
        out[size] = value if inside else 0
        size += 1 if inside | (code <= _BLOCK) else 0
        code = code if inside else value
        left = (left if inside else value) - 1
    return size if left == 0 else -1


class CobsDecoder(DelimitedDecoder):
    """Decoder for COBS frames, which contain the board's sequence number and time."""

    def __init__(self, rows: int, cols: int) -> None:
        super().__init__(rows, cols, b"\0", longest_frame(rows, cols))
        # Compile the kernel now instead of at the first frame.
        unstuff(np.frombuffer(bytearray(b"\1"), np.uint8), np.zeros(1, np.uint8))
        self._bad_crc = 0
        self._missed = 0
        self._seq: int | None = None
        self._ticks = 0
        self._t = 0.0  # time at which the last packet was read [s]
        self._wraps = 0  # number of overflows of the board clock

    def parse(self, packet: bytearray, t: float) -> Decoded | None:
        """Parse a packet with a sequence number and time; see :meth:`DelimitedDecoder.parse`."""
        if len(packet) >= self.longest:
            self._reason = f"packets of {len(packet)} bytes"
            return None
        message = np.empty(self.longest, np.uint8)
        size = unstuff(np.frombuffer(packet, np.uint8), message) - _CRC.size
        if size < _HEADER.size:
            self._reason = "packets that are too short or not COBS-encoded"
            return None
        if (
            binascii.crc_hqx(message.data[:size], _CRC_START)
            != _CRC.unpack_from(message.data, size)[0]
        ):
            self._bad_crc += 1
            self._reason = "packets with a wrong CRC"
            return None
        kind, version, seq, ticks, rows, cols = _HEADER.unpack_from(message.data)
        if kind not in (1, 2) or version != 0:
            self._reason = f"packets of unknown kind {kind}.{version}"
            return None
        if (rows, cols) != (self.rows, self.cols) or size != _HEADER.size + kind * rows * cols:
            self._reason = f"frames of {rows} × {cols} cells in {size} bytes"
            return None
        elapsed = (ticks - self._ticks) % 2**32 * _TICK
        # If the board clock is ahead of the local time by a second, the board has restarted.
        restarted = self._seq is None or elapsed > t - self._t + 1.0
        steps = 1 if restarted else (seq - self._seq - 1) % 65536 + 1
        self._missed += steps - 1
        self._seq, self._t = seq, t
        # A smaller tick count means that the clock has wrapped around or that the board has
        # restarted. SensorClock detects restarts.
        self._wraps += ticks < self._ticks
        self._ticks = ticks
        # Two-byte counts need no copy, because no other frame uses this buffer.
        cells = message[_HEADER.size : size].view(f"<u{kind}")
        counts = cells.astype(np.uint16, copy=False)
        t_sensor = (self._wraps * 2.0**32 + ticks) * _TICK
        return Decoded(counts.reshape(rows, cols), t, steps, t_sensor)

    def counters(self) -> dict[str, int]:
        """Return the common counters, ``bad_crc``, and ``missed`` (number of missing frames)."""
        return {**super().counters(), "bad_crc": self._bad_crc, "missed": self._missed}


class Cobs(SerialReader):
    """Board with COBS framing under one fingertip."""

    def make_decoder(self) -> CobsDecoder:
        return CobsDecoder(self.settings.rows, self.settings.cols)
