"""Unpacking of COBS packets against a byte-at-a-time twin, where zeros are dense and where not."""

from __future__ import annotations

import binascii

import numpy as np
import pytest

from softfinger.daemon.tactile.byte_masks import WIDTH, clear, equal, lowest
from softfinger.daemon.tactile.cobs_packet import BAD_CRC, NOT_COBS, crc16, crc_tables, unpack
from softfinger.kinematics.compiled.kernel import kernel
from tests.harness.called import called

# Inner kernels, made callable.
crc16 = called(crc16)

TABLES = crc_tables()


def pack(message: bytes) -> bytes:
    """COBS, a byte at a time, as its definition has it."""
    out = bytearray()
    block = bytearray()
    for position, value in enumerate(message):
        if value:
            block.append(value)
        if not value or len(block) == 254:
            out.append(len(block) + 1)
            out += block
            block.clear()
            if value and position == len(message) - 1:
                return bytes(out)
    out.append(len(block) + 1)
    return bytes(out + block)


def frames(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        size = int(rng.integers(0, 700))
        density = rng.choice([0.0, 0.02, 0.3, 0.5, 0.8, 0.97, 1.0])
        highest = int(rng.choice([2, 3, 256]))
        data = rng.integers(1, highest, size) * (rng.random(size) >= density)
        if rng.random() < 0.3:  # a block of 254 before dense codes, at any place
            data = np.concatenate([data, rng.integers(1, 3, 254 + int(rng.integers(0, 3))), data])
        yield bytes(data.astype(np.uint8))


def test_every_density_of_zeros_comes_back():
    for data in frames(3000, 1):
        message = data + binascii.crc_hqx(data, 0xFFFF).to_bytes(2, "little")
        packet = np.frombuffer(bytearray(pack(message)), np.uint8)
        out = np.full(len(packet), 0xAA, np.uint8)
        assert unpack(packet, TABLES, out) == len(data)
        assert bytes(out[: len(data)]) == data


def test_damage_is_told_or_leaves_the_frame_as_it_was():
    rng = np.random.default_rng(2)
    told = set()
    for data in frames(3000, 3):
        message = data + binascii.crc_hqx(data, 0xFFFF).to_bytes(2, "little")
        packet = bytearray(pack(message))
        packet[int(rng.integers(len(packet)))] ^= int(rng.integers(1, 256))
        out = np.zeros(len(packet), np.uint8)
        told.add(min(unpack(np.frombuffer(packet, np.uint8), TABLES, out), 0))
    assert told == {NOT_COBS, BAD_CRC}


def test_the_checksum_is_the_one_of_the_binascii_module():
    rng = np.random.default_rng(4)
    data = rng.integers(0, 256, 200, dtype=np.uint8)
    for size in range(200):
        assert crc16(data, size, TABLES) == binascii.crc_hqx(bytes(data[:size]), 0xFFFF)


@kernel
def _masks(data, at, mask):
    found = equal(data, at, 2)
    clear(data, at, np.uint64(mask))
    return found, lowest(found)


@pytest.mark.parametrize("at", [0, 3, 36])
def test_masks_of_64_bytes(at):
    rng = np.random.default_rng(5)
    data = rng.integers(0, 4, 100, dtype=np.uint8)
    before = data.copy()
    mask = int(rng.integers(0, 2**63))
    found, first = _masks(data, at, np.uint64(mask))
    places = [k for k in range(WIDTH) if before[at + k] == 2]
    assert int(found) == sum(1 << k for k in places)
    assert first == places[0]
    marked = [at + k for k in range(WIDTH) if mask >> k & 1]
    before[marked] = 0
    np.testing.assert_array_equal(data, before)
