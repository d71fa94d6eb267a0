"""Test the bytes and timestamps of the COBS framing, and the decoder against a reference."""

import re
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.daemon.tactile.cobs import CobsDecoder, encode, longest_frame, unstuff
from softfinger.daemon.tactile.serial_reader import SensorClock


def plain_stuff(message: bytes) -> bytes:
    """Encode data byte by byte according to the definition of COBS."""
    out, block = bytearray(), bytearray()
    for k, byte in enumerate(message):
        if byte == 0:
            out += bytes([len(block) + 1]) + block
            block = bytearray()
            continue
        block.append(byte)
        if len(block) == 254 and k < len(message) - 1:
            out += b"\xff" + block
            block = bytearray()
    return bytes(out + bytes([len(block) + 1]) + block)


def plain_crc(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def unstuffed(packet: bytes) -> bytes | None:
    out = np.full(len(packet), 0xAA, np.uint8)
    size = unstuff(np.frombuffer(bytearray(packet), np.uint8), out)
    return None if size < 0 else out[:size].tobytes()


messages = st.one_of(
    st.binary(max_size=60),
    st.lists(st.sampled_from([0, 0, 1, 255]), max_size=40).map(bytes),
    st.integers(250, 1100).map(lambda n: bytes(k % 255 + 1 for k in range(n))),
)


@given(messages)
@example(b"")
@example(bytes(300))
@example(b"\x01" * 254)
@example(b"\x01" * 508)
def test_decoding_inverts_the_plain_encoder(message):
    assert unstuffed(plain_stuff(message)) == message


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_frame_has_the_documented_bytes(kind):
    assert plain_crc(b"123456789") == 0x29B1
    counts = np.array([[0, 1, 2], [253, 0, 255]], kind)
    data = encode(counts, 70000, 1.25)
    assert data.endswith(b"\0")
    assert data.count(b"\0") == 1
    size = kind().itemsize
    message = struct.pack("<BBHIHH", size, 0, 70000 % 65536, 1250000, 2, 3)
    message += struct.pack("<6" + ("B" if size == 1 else "H"), *counts.ravel().tolist())
    assert data == plain_stuff(message + plain_crc(message).to_bytes(2, "little")) + b"\0"


def test_frames_have_numbers_and_times_and_losses_are_counted():
    decoder = CobsDecoder(2, 3)
    counts = np.arange(6, dtype=np.uint16).reshape(2, 3) * 300
    first = decoder.feed(encode(counts, 65534, 4294.0), 1.0)
    second = decoder.feed(encode(counts, 1, 4295.0), 2.0)  # The clock wraps around at 4294.97 s.
    assert np.array_equal(second.data, counts)
    assert second.steps == 3
    assert second.t_sensor == pytest.approx(first.t_sensor + 1.0)
    assert decoder.counters()["missed"] == 2
    again = decoder.feed(encode(counts, 0, 0.0), 3.0)  # The board has restarted.
    assert again.steps == 1


@pytest.mark.parametrize("seq", [1, 20000, 40000, 65535])
def test_a_restart_is_not_counted_as_a_loss(seq):
    decoder = CobsDecoder(2, 3)
    counts = np.zeros((2, 3), np.uint16)
    decoder.feed(encode(counts, seq, 0.01 * seq), 1.0)
    assert decoder.feed(encode(counts, 0, 0.0), 4.0).steps == 1
    assert decoder.feed(encode(counts, 100, 1.0), 5.0).steps == 100
    assert decoder.counters()["missed"] == 99


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda data: encode(np.zeros((3, 2), np.uint16), 1, 0.0), r"3 × 2.*2 × 3"),
        (lambda data: data[:3] + bytes([data[3] ^ 4]) + data[4:], "wrong CRC|not COBS"),
        (lambda data: data[4:], "wrong CRC|not COBS"),
        (lambda data: b"\x01" * 500 + b"\0", "packets of 500 bytes|no packet"),
    ],
)
def test_stream_errors_are_diagnosed(spoil, told):
    decoder = CobsDecoder(2, 3)
    good = encode(np.full((2, 3), 777, np.uint16), 1, 0.0)
    assert decoder.feed(spoil(good), 0.0) is None
    assert re.search(told, decoder.diagnosis())
    assert decoder.feed(b"\0" + good, 0.0) is not None


def test_every_single_bit_flip_is_detected():
    good = encode(np.random.default_rng(1).integers(0, 900, (4, 5)).astype(np.uint16), 5, 0.5)
    for bit in range(8 * len(good)):
        wrong = bytearray(good)
        wrong[bit // 8] ^= 1 << bit % 8
        decoder = CobsDecoder(4, 5)
        # The flipped bit may also create or remove a delimiter.
        assert decoder.feed(bytes(wrong) + b"\0", 0.0) is None


def test_the_sensor_clock_uses_the_minimum_delay_and_follows_drift_and_restarts():
    clock = SensorClock()
    rng = np.random.default_rng(2)
    misses = []
    for k in range(2000):
        scan = 0.01 * k
        late = 0.003 * rng.random()
        misses.append(clock.arrival(scan * (1 - 5e-5) + 77.0, scan + late) - scan)
    assert max(misses[200:]) < 3e-4  # The delays are up to 3 ms.
    assert min(misses) > -1e-4
    assert clock.arrival(0.0, 30.0) == 30.0


def test_the_longest_frame_consists_of_zeros():
    rng = np.random.default_rng(3)
    # Half of the cells are zero, as in a frame without contact. The encoded frame is longest if all
    # its bytes are zero.
    frames = [
        encode(np.maximum(rng.normal(0, 380, (44, 44)), 0).astype(np.uint16), k, 0.01 * k)
        for k in range(30)
    ]
    assert max(map(len, frames)) <= longest_frame(44, 44) == 3903
    decoder = CobsDecoder(44, 44)
    assert all(decoder.feed(data, 0.0) is not None for data in frames)
