"""Test the emulated servo bus with published packet exchanges, reply rules and line faults."""

import struct
from typing import Any

import pytest

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, PacketParser, frame
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.testing.emulated import FreeJoints
from tests.fuzz.servo_bus import fuzz
from tests.harness.servos import RADIAN, BusClient, hand_bus, make_bus


def hexes(*texts: str) -> bytes:
    return b"".join(bytes.fromhex(text) for text in texts)


# --- published exchanges
# ----------------------------------------------------------------------------

DONE = "FFFFFD00010400 55 00 A10C"
XC330 = {"model": "XC330-T288"}
THREE = {**XC330, "ids": (3, 7, 4), "counts": (166, 2079, 1023)}


@pytest.mark.parametrize(
    ("options", "asked", "answers"),
    [
        ({"firmware": 38}, "010300 01 194E", ["FFFFFD00010700 55 00 060426 655D"]),
        (
            {"firmware": 38},
            "FE0300 01 3142",
            ["FFFFFD00010700 55 00 060426 655D", "FFFFFD00020700 55 00 060426 6F6D"],
        ),
        (
            {"counts": (166, 0)},
            "010700 02 84000400 1D15",
            ["FFFFFD00010800 55 00 A6000000 8CC0"],
        ),
        (
            {"counts": (166, 2079)},
            "FE0900 82 840004000102 CEFA",
            ["FFFFFD00010800 55 00 A6000000 8CC0", "FFFFFD00020800 55 00 1F080000 BABE"],
        ),
        (
            THREE,
            "FE0A00 8A 84000400 030704 20F2",
            [
                "FFFFFD00FE1900 55 00 03 A6000000 8408",
                "00 07 1F080000 16CA",
                "00 04 FF030000 D19E",
            ],
        ),
        (XC330, "010400 06 01 A1E6", [DONE]),
        (XC330, "010300 08 2F4E", [DONE]),
        (XC330, "010800 10 0144584C22 B1DC", [DONE]),
    ],
    ids=[
        "ping",
        "broadcast ping",
        "read",
        "sync read",
        "fast sync read",
        "factory reset",
        "reboot",
        "clear",
    ],
)
def test_published_read_exchanges(options: dict[str, Any], asked: str, answers: list[str]) -> None:
    assert make_bus(**options).feed(hexes("FFFFFD00", asked), 0.0) == hexes(*answers)


def test_published_write_exchanges() -> None:
    bus = make_bus()
    left = bus.servos[0].table
    assert bus.feed(hexes("FFFFFD00010900 03 740000020000 CA89"), 0.0) == hexes(DONE)
    assert left.get(reg.GOAL_POSITION) == 512
    assert bus.feed(hexes("FFFFFD00FE1100 83 74000400 0196000000 02AA000000 8287"), 0.0) == b""
    assert [servo.table.get(reg.GOAL_POSITION) for servo in bus.servos] == [150, 170]


def test_published_bulk_read_and_bulk_write() -> None:
    bus = make_bus()
    bus.servos[0].supply = 11.9
    bus.servos[1].heat.warm(36.0)
    assert bus.feed(hexes("FFFFFD00FE0D00 92 0190000200 0292000100 1A05"), 0.0) == hexes(
        "FFFFFD00010600 55 00 7700 C369", "FFFFFD00020500 55 00 24 8BA9"
    )
    bus.servos[0].table.set(reg.MAX_VOLTAGE_LIMIT, 150)
    bus.servos[1].table.set(reg.TEMPERATURE_LIMIT, 70)
    packet = hexes("FFFFFD00FE1000 93 0120000200A000 021F00010050 B768")
    assert bus.feed(packet, 0.0) == b""
    assert bus.servos[0].table.get(reg.MAX_VOLTAGE_LIMIT) == 160
    assert bus.servos[1].table.get(reg.TEMPERATURE_LIMIT) == 80


def test_published_fast_bulk_read() -> None:
    bus = make_bus("XC330-T288", (3, 7, 4), counts=(166, 0, 0))
    bus.servos[2].heat.warm(31.0)
    pwm = bus.servos[1]
    pwm.table.set(reg.TORQUE_ENABLE, 1)
    bus.plant.current[1] = 421 / 885 * pwm.model.stall_current
    request = frame(BROADCAST, framing.FAST_BULK_READ, hexes("0384000400077C0002000492000100"))
    assert bus.feed(request, 0.0) == hexes(
        "FFFFFD00FE1400 55 00 03 A6000000 67A4", "00 07 A501 2474", "00 04 1F D9C1"
    )


# --- reply rules and timing
# -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "answers"), [(0, (True, False, False)), (1, (True, True, False)), (2, (True,) * 3)]
)
def test_status_return_level(level: int, answers: tuple[bool, bool, bool]) -> None:
    c = BusClient()
    c.write(reg.STATUS_RETURN_LEVEL, level, 1)
    replies = (
        c.send(1, framing.PING),
        c.send(1, framing.READ, struct.pack("<HH", reg.ID, 1)),
        c.send(1, framing.WRITE, struct.pack("<HB", reg.LED, 1)),
    )
    assert tuple(bool(reply) for reply in replies) == answers
    assert c.bus.servos[0].table.get(reg.LED) == 1


def test_a_new_id_takes_effect_after_the_reply_under_the_old_one() -> None:
    c = BusClient()
    assert c.write(reg.ID, 40, 1) == 0
    assert c.send(1, framing.PING) == b""
    assert c.ask(framing.PING, packet_id=40)[0] == 0


def test_broadcast_reads_and_writes_get_no_reply() -> None:
    c = BusClient()
    assert c.send(BROADCAST, framing.READ, struct.pack("<HH", 132, 4)) == b""
    assert c.send(BROADCAST, framing.WRITE, struct.pack("<HB", reg.LED, 1)) == b""
    assert all(servo.table.get(reg.LED) for servo in c.bus.servos)


def test_a_missing_servo_silences_those_listed_after_it() -> None:
    c = BusClient(ids=(1, 2, 3))
    packets = PacketParser().feed(
        c.send(BROADCAST, framing.SYNC_READ, struct.pack("<HH", 132, 4) + bytes((1, 9, 3))), 0.0
    )
    assert [packet.id for packet in packets] == [1]


def test_an_old_firmware_lacks_fast_reads() -> None:
    request = struct.pack("<HHBB", 132, 4, 1, 2)
    old = BusClient(model="XL330-M288", firmware=45)
    assert old.send(BROADCAST, framing.FAST_SYNC_READ, request) == b""
    assert len(old.send(BROADCAST, framing.SYNC_READ, request)) == 2 * 15
    new = BusClient(model="XL330-M288", firmware=46)
    assert len(new.send(BROADCAST, framing.FAST_SYNC_READ, request)) == 8 + 2 * 8


def test_a_corrupted_packet_gets_no_reply() -> None:
    damaged = bytearray(frame(1, framing.READ, struct.pack("<HH", 132, 4)))
    damaged[-1] ^= 1
    assert make_bus().feed(bytes(damaged), 0.0) == b""


def test_servos_at_another_rate_receive_nothing() -> None:
    c = BusClient()
    ping = frame(BROADCAST, framing.PING)
    assert c.bus.feed(ping, c.t, baud=1_000_000) == b""
    assert len(c.bus.feed(ping, c.t, baud=57600)) == 28
    assert c.write(reg.BAUD_RATE, 3, 1, packet_id=2) == 0
    assert len(c.bus.feed(ping, c.t, baud=57600)) == 14
    assert len(c.bus.feed(ping, c.t, baud=1_000_000)) == 14


# --- servos that reply simultaneously
# ---------------------------------------------------------------


def test_servos_with_the_same_id_reply_simultaneously() -> None:
    bus = make_bus(ids=(1, 1, 2), counts=(100, 200, 300))
    read = frame(1, framing.READ, b"\x84\x00\x04\x00")
    low, high = (framing.status(1, 0, (100 * k).to_bytes(4, "little")) for k in (1, 2))
    both = zip(low + b"\xff", b"\xff" + high, strict=True)
    assert bus.feed(read, 0.0) == bytes(a & b for a, b in both)
    assert len(bus.feed(frame(2, framing.PING), 0.0)) == 14
    assert bus.feed(frame(BROADCAST, framing.PING), 0.0)[-14:-9] == b"\xff\xff\xfd\x00\x02"
    group = frame(BROADCAST, framing.SYNC_READ, b"\x84\x00\x04\x00\x02\x01")
    assert bus.feed(group, 0.0)[:5] == b"\xff\xff\xfd\x00\x02"


# --- injected faults
# --------------------------------------------------------------------------------


def test_reply_faults_are_injected_reproducibly() -> None:
    def replies(fault: str, chance: float) -> list[bytes]:
        bus = make_bus()
        bus.fault(fault, chance, 0.0)
        ping = frame(1, framing.PING)
        return [bus.feed(ping, 0.001 * i) for i in range(400)]

    whole = make_bus().feed(frame(1, framing.PING), 0.0)
    dropped = replies("drop", 0.25)
    assert 60 < dropped.count(b"") < 140
    assert set(dropped) == {b"", whole}
    assert all(reply == whole[: len(reply)] for reply in replies("truncate", 1))
    assert set(replies("duplicate", 1)) == {whole + whole}
    for reply in replies("corrupt", 1):
        flipped = int.from_bytes(reply, "big") ^ int.from_bytes(whole, "big")
        assert flipped.bit_count() == 1
    assert replies("drop", 0.25) == dropped
    late = make_bus()
    late.fault("late", 1.0, 0.0)
    assert late.exchange(frame(1, framing.PING), 0.0)[0].late > 0.0


def test_a_silent_servo_can_be_restored() -> None:
    c = BusClient()
    c.bus.fault("silent", 2, c.t)
    assert c.send(2, framing.PING) == b""
    assert c.send(1, framing.PING) != b""
    c.bus.fault("answer", 2, c.t)
    assert c.send(2, framing.PING) != b""


# --- mapping of the hand
# ----------------------------------------------------------------------------


def test_directions_and_zero_offsets_of_the_settings() -> None:
    plant = FreeJoints(2)
    plant.q[:] = 0.3
    bus = ServoBus.from_settings(Settings(), plant)
    c = BusClient(bus)
    turn = round(0.3 / RADIAN)
    assert c.read(reg.PRESENT_POSITION, 4, 1) == 2048 + turn
    assert c.read(reg.PRESENT_POSITION, 4, 2) == 2048 - turn
    assert c.read(reg.OPERATING_MODE, 1, 2) == reg.CURRENT_BASED_POSITION_MODE
    with pytest.raises(SettingsError, match="does not support 4500000 baud"):
        hand_bus(servos={"model": "XL330-M288"}, baud=4_500_000)


def test_a_reading_may_lag_behind_the_plant_but_writes_and_watchdogs_may_not() -> None:
    c = BusClient(for_daemon=True)
    bus = c.bus
    bus.lag = 0.0005
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.BUS_WATCHDOG, 1, 1)
    t = bus.now

    def read(after: float) -> float:
        ask = framing.frame(1, framing.READ, struct.pack("<HH", reg.BUS_WATCHDOG, 1))
        assert bus.feed(ask, t + after)
        return bus.now - t

    assert read(0.0004) == 0.0
    assert read(0.0006) == pytest.approx(0.0006)
    bus.feed(framing.frame(1, framing.WRITE, struct.pack("<HH", reg.GOAL_CURRENT, 5)), t + 0.001)
    assert bus.now - t == pytest.approx(0.001)
    bus.advance(t + 0.0208)
    assert read(0.021) == pytest.approx(0.021)
    assert bus.servos[0].report(bus.now)["stopped_by_watchdog"]


# --- random input
# -----------------------------------------------------------------------------------


def test_thousands_of_mutated_packets_cause_neither_crash_nor_hang() -> None:
    report = fuzz(6000, seed=5)
    assert report.through > 1000
    assert report.wrong == []
