"""Implement the framing of Dynamixel Protocol 2.0 on the servo side.

This module shares only the CRC with the client, so tests against the client are meaningful.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from softfinger.daemon.servos.control_table import crc16

HEADER: Final = b"\xff\xff\xfd"
BROADCAST: Final = 0xFE
ID_MAX: Final = 252

PING: Final = 0x01
READ: Final = 0x02
WRITE: Final = 0x03
REG_WRITE: Final = 0x04
ACTION: Final = 0x05
FACTORY_RESET: Final = 0x06
REBOOT: Final = 0x08
CLEAR: Final = 0x10
STATUS: Final = 0x55
SYNC_READ: Final = 0x82
SYNC_WRITE: Final = 0x83
FAST_SYNC_READ: Final = 0x8A
BULK_READ: Final = 0x92
BULK_WRITE: Final = 0x93
FAST_BULK_READ: Final = 0x9A

# Error numbers in a status packet. In addition, bit 7 (ALERT) indicates a hardware error.
OK: Final = 0x00
RESULT_FAIL: Final = 0x01
INSTRUCTION_ERROR: Final = 0x02
DATA_RANGE: Final = 0x04
DATA_LENGTH: Final = 0x05
DATA_LIMIT: Final = 0x06
ACCESS: Final = 0x07
ALERT: Final = 0x80

MAX_LENGTH: Final = 1024  # maximum packet length that a servo accepts [bytes]
_PREFIX: Final = HEADER + b"\x00"
_STUFFED: Final = HEADER + b"\xfd"
_UNSTUFFED: Final = re.compile(rb"\xff\xff\xfd[^\xfd]")


def frame(packet_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a complete packet: header, stuffed length, stuffed body, CRC."""
    body = (bytes((instruction,)) + parameters).replace(HEADER, _STUFFED)
    length = len(body) + 2
    packet = _PREFIX + bytes((packet_id, length & 0xFF, length >> 8)) + body
    return packet + crc16(packet).to_bytes(2, "little")


def status(packet_id: int, error: int, data: bytes = b"") -> bytes:
    """Return a status packet."""
    return frame(packet_id, STATUS, bytes((error,)) + data)


def fast_head(length: int) -> bytes:
    """Return the first bytes of the combined reply to a fast group read."""
    return _PREFIX + bytes((BROADCAST, length & 0xFF, length >> 8 & 0xFF, STATUS))


def old_status(packet_id: int) -> bytes:
    """Return a Protocol 1.0 status packet that contains no error and no data."""
    body = bytes((packet_id, 2, 0))
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def old_pings(data: bytes) -> list[int]:
    """Return the IDs of all Protocol 1.0 pings in ``data``."""
    found = re.finditer(rb"\xff\xff([\x00-\xfe]\x02\x01)(.)", data, re.DOTALL)
    return [m[1][0] for m in found if ~sum(m[1]) & 0xFF == m[2][0]]


class Packet(NamedTuple):
    """Received packet. ``valid`` is False if the CRC is wrong but everything else is correct."""

    id: int
    instruction: int
    parameters: bytes
    valid: bool


class PacketParser:
    """Packet parser that behaves like a real servo.

    The parser discards a packet if silence of more than ``gap`` seconds interrupts the packet. A
    packet that contains an unstuffed header (FF FF FD not followed by FD) is also discarded and
    therefore never executed.
    """

    def __init__(self, gap: float = 0.0015) -> None:
        self.gap = gap
        self._buffer = bytearray()
        self._last = 0.0

    def feed(self, data: bytes, t: float) -> list[Packet]:
        """Return the packets completed by ``data``, which arrived at time t [s]."""
        if t - self._last > self.gap:
            self._buffer.clear()
        self._last = t
        self._buffer += data
        return list(iter(self._next, None))

    def reset(self) -> None:
        """Discard an incomplete packet."""
        self._buffer.clear()

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            start = buffer.find(_PREFIX)
            if start < 0:
                del buffer[:-3]  # The last bytes may be the start of a header.
                return None
            del buffer[:start]
            if len(buffer) < 7:
                return None
            packet_id = buffer[4]
            length = buffer[5] | buffer[6] << 8
            if packet_id in (0xFD, 0xFF) or not 3 <= length <= MAX_LENGTH - 7:
                del buffer[: len(HEADER)]
                continue
            end = 7 + length
            body = bytes(buffer[7 : end - 2])
            if len(buffer) > end - 2:
                body += b"\0"  # A header at the end of the body counts as unstuffed.
            if intruder := _UNSTUFFED.search(body):
                del buffer[: 7 + intruder.start()]
                continue
            if len(buffer) < end:
                return None
            raw = bytes(buffer[:end])
            del buffer[:end]
            body = raw[7:-2].replace(_STUFFED, HEADER)
            valid = crc16(raw[:-2]) == raw[-2] | raw[-1] << 8
            return Packet(packet_id, body[0], body[1:], valid)
