"""Compiled unpacking of one COBS packet with its CRC-16. Bytes alone; no frames, no headers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.kernels import kernel

Bytes = NDArray[np.uint8]
CRC_START = 0xFFFF
_POLYNOMIAL = 0x1021
_AT_ONCE = 8  # bytes that the CRC takes in one step

NOT_COBS = -1
BAD_CRC = -2


def crc_tables() -> NDArray[np.uint16]:
    """What 8 successive bytes contribute to the CRC, uint16 [8, 256]; row 0 is the last byte's."""
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


@kernel
def crc16(data: Bytes, size: int, tables: NDArray[np.uint16]) -> int:
    """CRC-16/IBM-3740 of the first ``size`` bytes: polynomial 0x1021, start 0xFFFF, no inversion.

    Eight bytes a step, so that the steps' dependence costs an eighth.
    """
    crc = np.uint32(CRC_START)
    low = np.uint32(0xFF)
    shift = np.uint32(8)
    k = 0
    while k + 8 <= size:
        crc = (
            np.uint32(tables[7, (crc >> shift) ^ data[k]])
            ^ np.uint32(tables[6, (crc & low) ^ data[k + 1]])
            ^ np.uint32(tables[5, data[k + 2]])
            ^ np.uint32(tables[4, data[k + 3]])
            ^ np.uint32(tables[3, data[k + 4]])
            ^ np.uint32(tables[2, data[k + 5]])
            ^ np.uint32(tables[1, data[k + 6]])
            ^ np.uint32(tables[0, data[k + 7]])
        )
        k += 8
    while k < size:
        crc = ((crc & low) << shift) ^ np.uint32(tables[0, (crc >> shift) ^ data[k]])
        k += 1
    return int(crc)


@kernel
def _copy(source: Bytes, out: Bytes) -> None:
    # Indices that start at 0 need no look at their sign, so this becomes vector instructions.
    for k in range(source.shape[0]):
        out[k] = source[k]


@kernel
def unpack(packet: Bytes, tables: NDArray[np.uint16], out: Bytes) -> int:
    """Undo COBS and check the CRC-16 in the last two bytes (low first).

    ``packet`` has no delimiter; ``out`` needs its length. Returns the number of bytes in ``out``
    before the CRC, or NOT_COBS or BAD_CRC.

    A code byte stands where a zero of the data stands, but for the first and those behind blocks of
    254 bytes. So all is copied at once, again behind each such block, and then only the chain of
    codes is walked: a byte at a time would stumble at each of its unforeseeable ends.
    """
    size = packet.shape[0]
    place = 0  # of a code byte in the packet
    ahead = 1  # bytes by which the packet is ahead of the data
    code = int(packet[0])
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
    length = size - ahead - 2
    if length < 0:
        return BAD_CRC
    crc = int(out[length]) | (int(out[length + 1]) << 8)
    return length if crc16(out, length, tables) == crc else BAD_CRC
