"""Test that Protocol 2.0 framing produces published packets; test properties of the parser."""

import pytest
from dynamixel_sdk import PacketHandler as sdk_handler
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.servos.control_table import crc16
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import (
    PacketParser,
    frame,
)

# Most of these byte sequences occur in packet headers, whose first bytes require byte stuffing.
PIECES = [b"\xff\xff\xfd", b"\xff", b"\xfd", b"\x00", b"\x55", b"\x12"]
payloads = st.lists(st.sampled_from(PIECES), max_size=40).map(b"".join)


@given(st.binary(max_size=300))
def test_crc_equals_that_of_the_sdk(data):
    assert crc16(data) == sdk_handler(2.0).updateCRC(0, data, len(data))


@given(payloads)
def test_stuffing_is_inverted_and_leaves_no_header(body):
    packet = frame(1, framing.WRITE, body)
    at = packet.find(b"\xff\xff\xfd", 7)
    while at >= 0:
        assert packet[at + 3] == 0xFD
        at = packet.find(b"\xff\xff\xfd", at + 1)
    (parsed,) = PacketParser().feed(packet, 0.0)
    assert parsed.parameters == body


@given(
    st.lists(st.tuples(st.integers(0, 252), st.integers(1, 255), payloads), min_size=1, max_size=5),
    st.data(),
)
def test_the_parser_finds_every_packet_for_any_split(contents, data):
    stream = b"".join(frame(*content) for content in contents)
    parser = PacketParser()
    found = []
    at = 0
    while at < len(stream):
        size = data.draw(st.integers(1, len(stream) - at))
        found += parser.feed(stream[at : at + size], 0.0)
        at += size
    assert [(p.id, p.instruction, p.parameters) for p in found] == contents
    assert all(packet.valid for packet in found)


@given(st.binary(max_size=60), payloads)
def test_the_parser_recovers_after_any_noise(noise, body):
    parser = PacketParser(gap=0.0015)
    parser.feed(noise, 0.0)
    found = parser.feed(frame(7, framing.WRITE, body), 1.0)
    assert [(p.id, p.parameters, p.valid) for p in found] == [(7, body, True)]


def test_an_incomplete_packet_does_not_swallow_the_next():
    whole = frame(1, framing.WRITE, bytes(20))
    found = PacketParser().feed(whole[:15] + frame(2, framing.PING), 0.0)
    assert [(p.id, p.instruction) for p in found] == [(2, framing.PING)]


def test_an_unstuffed_packet_is_ignored():
    goals = bytes.fromhex("6600 FFFF FDFFFFFF")
    raw = b"\xff\xff\xfd\x00\x01" + (len(goals) + 3).to_bytes(2, "little") + b"\x03" + goals
    raw += crc16(raw).to_bytes(2, "little")
    assert PacketParser().feed(raw, 0.0) == []


def test_a_corrupted_packet_is_marked_as_invalid():
    damaged = bytearray(frame(1, framing.READ, bytes(4)))
    damaged[9] ^= 4
    (packet,) = PacketParser().feed(bytes(damaged), 0.0)
    assert not packet.valid


def test_silence_within_a_packet_discards_it():
    packet = frame(1, framing.PING)
    parser = PacketParser(gap=0.0015)
    assert parser.feed(packet[:6], 0.0) == []
    assert parser.feed(packet[6:], 0.002) == []
    assert len(parser.feed(packet, 0.0021)) == 1


@pytest.mark.parametrize("bad_id", [0xFD, 0xFF])
def test_invalid_servo_ids_are_rejected(bad_id):
    assert PacketParser().feed(frame(bad_id, framing.PING), 0.0) == []
