"""Compiled unpacking of one COBS packet with its CRC-16. Bytes alone; no frames, no headers."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.tactile.byte_masks import WIDTH, clear, equal, lowest
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.unowned import borrowed

Bytes = NDArray[np.uint8]
Mask: TypeAlias = np.uint64
CRC_START = 0xFFFF
_POLYNOMIAL = 0x1021
_AT_ONCE = 16  # bytes that the CRC takes in one step
NOT_COBS = -1
BAD_CRC = -2


def crc_tables() -> NDArray[np.uint16]:
    """What 16 successive bytes add to the CRC, uint16 [16, 256]; row 0 is the last byte's."""
    tables = np.zeros((_AT_ONCE, 256), np.uint16)
    for value in range(256):
        crc = value << 8
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x8000 else 0)
        tables[0, value] = crc & 0xFFFF
    for row in range(1, _AT_ONCE):
        # One zero byte more behind it.
        before = tables[row - 1].astype(np.int64)
        tables[row] = ((before << 8) & 0xFFFF) ^ tables[0, before >> 8]
    return tables


@inner_kernel
def crc16(data: Bytes, size: int, tables: NDArray[np.uint16]) -> int:
    """CRC-16/IBM-3740 of the first ``size`` bytes: polynomial 0x1021, start 0xFFFF, no inversion.

    Sixteen bytes a step, so that the steps' dependence costs a sixteenth.
    """
    crc = np.uint32(CRC_START)
    low = np.uint32(0xFF)
    shift = np.uint32(8)
    k = 0
    while k + _AT_ONCE <= size:
        # What doesn't wait for the step before comes first.
        later = np.uint32(0)
        for m in range(2, _AT_ONCE):
            later ^= np.uint32(tables[_AT_ONCE - 1 - m, data[k + m]])
        crc = (
            np.uint32(tables[_AT_ONCE - 1, (crc >> shift) ^ data[k]])
            ^ np.uint32(tables[_AT_ONCE - 2, (crc & low) ^ data[k + 1]])
            ^ later
        )
        k += _AT_ONCE
    while k < size:
        crc = ((crc & low) << shift) ^ np.uint32(tables[0, (crc >> shift) ^ data[k]])
        k += 1
    return int(crc)


@inner_kernel
def _copy(source: Bytes, out: Bytes) -> None:
    # Indices that start at 0 need no look at their sign, so this becomes vector instructions.
    for k in range(source.shape[0]):
        out[k] = source[k]


@inner_kernel
def _short_codes(packet: Bytes, place: int) -> tuple[Mask, int]:
    """Which of the 64 bytes from the code at ``place`` on are codes, up to the first above 2.

    Also the last of them. A byte is none where the one before is a code of 2; along a row of twos
    that alternates, which an addition's carry works out for all 64 at once.
    """
    one = np.uint64(1)
    even = np.uint64(0x5555555555555555)
    twos = equal(packet, place, 2)
    behind = twos << one
    starts = twos & ~even & ~behind
    skipped = (even ^ ((starts + twos) << one)) & behind
    codes = ~skipped
    end = lowest(codes & ~(twos | equal(packet, place, 1)))
    if end < WIDTH:
        return codes & ((np.uint64(2) << np.uint64(end)) - one), end
    return codes, WIDTH - 1 if codes >> np.uint64(WIDTH - 1) else WIDTH - 2


@kernel
def unpack(packet: Bytes, tables: NDArray[np.uint16], out: Bytes) -> int:
    """Undo COBS and check the CRC-16 in the last two bytes (low first).

    ``packet`` has no delimiter; ``out`` needs its length. Returns the number of bytes in ``out``
    before the CRC, or NOT_COBS or BAD_CRC.

    A code byte stands where a zero of the data stands, but for the first and those behind blocks of
    254 bytes. So all is copied at once, again behind each such block, and then only the chain of
    codes is walked: a byte at a time would stumble at each of its unforeseeable ends. Where
    zeros are dense, as where nothing presses, many codes are taken at once.
    """
    packet = borrowed(packet)
    tables = borrowed(tables)
    out = borrowed(out)
    size = packet.shape[0]
    place = 0  # of a code byte in the packet
    ahead = 1  # bytes by which the packet is ahead of the data
    code = int(packet[0])
    dense = 0  # a bit for each of the last four codes: up to 2
    _copy(packet[1:], out)
    while True:
        place += code
        if code == 0 or place > size:
            return NOT_COBS
        if place == size:
            break
        if code == 255:
            ahead += 1
            _copy(packet[place + 1 :], out[place + 1 - ahead :])
        else:
            out[place - ahead] = 0
        code = int(packet[place])
        dense = ((dense << 1) & 15) | (1 if code <= 2 else 0)
        if dense == 15 and place + WIDTH <= size:
            codes, last = _short_codes(packet, place)
            # The code here stands for a zero: behind a block of 254 bytes codes are not dense.
            clear(out, place - ahead, codes)
            place += last
            code = int(packet[place])
            dense = 15 if code <= 2 else 0
    length = size - ahead - 2
    if length < 0:
        return BAD_CRC
    crc = int(out[length]) | (int(out[length + 1]) << 8)
    return length if crc16(out, length, tables) == crc else BAD_CRC
