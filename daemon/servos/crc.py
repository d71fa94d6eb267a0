"""CRC-16 of Protocol 2.0, two bytes a step, for the client and the emulated servos."""

from __future__ import annotations

import struct
from array import array

import numpy as np

_LONGEST = 1024  # bytes of a packet


def _of_bytes() -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
    """Remainders of every byte."""
    crc = np.arange(256, dtype=np.uint16) << np.uint16(8)
    for _ in range(8):
        crc = crc << np.uint16(1) ^ np.where(crc & 0x8000, 0x8005, 0).astype(np.uint16)
    return crc


def _of_words(byte: np.ndarray[tuple[int], np.dtype[np.uint16]]) -> array[int]:
    """Remainders of every two bytes, most significant first.

    An array and no tuple: 128 KB stay in the cache where two megabytes of numbers would not.
    """
    word = np.arange(1 << 16, dtype=np.uint32)
    first = byte[word >> 8]
    table = first << np.uint16(8) ^ byte[first >> 8 ^ (word & 0xFF)]
    return array("H", table.astype(np.uint16).tobytes())


_BYTE = _of_bytes()
_WORD = _of_words(_BYTE)
_WORDS = [struct.Struct(f">{count >> 1}H").unpack_from for count in range(_LONGEST + 1)]


def crc16(data: bytes, crc: int = 0) -> int:
    """Return CRC-16 (polynomial 0x8005, initial 0) that ends every packet."""
    table = _WORD
    count = len(data)
    if count > _LONGEST:
        return crc16(data[_LONGEST:], crc16(data[:_LONGEST], crc))
    for word in _WORDS[count](data):
        crc = table[crc ^ word]
    if count & 1:
        crc = (crc & 0xFF) << 8 ^ int(_BYTE[crc >> 8 ^ data[-1]])
    return crc
