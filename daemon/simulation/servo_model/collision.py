"""What a client receives when several servos answer at once: their bits on one line.

The line idles high and a low bit wins. Servos start within JITTER of each other, so that replies
that are alike may even come through whole, at slow rates above all.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

JITTER = 20e-6  # s by which return delays of servos of one setting differ
_FRAME = 10  # bits of a byte on the wire: start, eight data bits from the lowest, stop


def collide(replies: Sequence[bytes], baud: int, source: random.Random) -> bytes:
    """The bytes that come of ``replies`` sent at once."""
    return overlay([(round(source.random() * JITTER * baud), reply) for reply in replies])


def overlay(streams: Sequence[tuple[int, bytes]]) -> bytes:
    """Bytes that a UART makes of streams that each begin at a number of bits."""
    length = max(start + _FRAME * len(data) for start, data in streams)
    line = [1] * (length + _FRAME)
    for start, data in streams:
        for i, byte in enumerate(data):
            at = start + _FRAME * i
            line[at] = 0
            for bit in range(8):
                line[at + 1 + bit] &= byte >> bit & 1
    heard = bytearray()
    at = 0
    while at < length:
        if line[at]:
            at += 1
            continue
        byte = sum(line[at + 1 + bit] << bit for bit in range(8))
        stop = line[at + 9]
        heard.append(byte if stop else 0)  # a byte without its stop bit is read as 0
        at += _FRAME
        while at < length and not stop and not line[at]:
            at += 1  # the line must rise before a byte can start
    return bytes(heard)
