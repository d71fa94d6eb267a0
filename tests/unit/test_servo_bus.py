"""The emulated servo bus: published exchanges byte for byte, and a servo's rules."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import MODELS, by_name
from softfinger.daemon.simulation.physics.free_joints import FreeJoints
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.bus_faults import FaultError
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, Parser, frame
from softfinger.daemon.simulation.servo_model.servo import REBOOT_TIME
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.simulation.servo_model.servo_health import OVERLOAD_TIME
from tests.fuzz.servo_bus import fuzz
from tests.harness.servos import RADIAN, hand_bus, make_bus

FORMS = {1: "<B", 2: "<H", 4: "<I"}


class Client:
    """Talks to a bus at its own time; parses the replies with the independent parser."""

    def __init__(self, bus: ServoBus) -> None:
        self.bus = bus
        self.t = 0.001

    def send(self, packet_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        return self.bus.feed(frame(packet_id, instruction, parameters), self.t)

    def ask(
        self, instruction: int, parameters: bytes = b"", packet_id: int = 1
    ) -> tuple[int, bytes]:
        """(error byte, data) of the one reply."""
        (packet,) = Parser().feed(self.send(packet_id, instruction, parameters), 0.0)
        assert packet.valid
        assert packet.instruction == framing.STATUS
        return packet.parameters[0], packet.parameters[1:]

    def read(self, address: int, size: int, packet_id: int = 1) -> int:
        error, data = self.ask(framing.READ, struct.pack("<HH", address, size), packet_id)
        assert error & 0x7F == 0, f"error {error}"
        return int.from_bytes(data, "little", signed=True)

    def write(self, address: int, value: int, size: int, packet_id: int = 1) -> int:
        """The error byte."""
        data = address.to_bytes(2, "little") + value.to_bytes(size, "little", signed=value < 0)
        return self.ask(framing.WRITE, data, packet_id)[0]

    def later(self, seconds: float) -> None:
        self.t += seconds
        self.bus.advance(self.t)


def client(**options: object) -> Client:
    return Client(make_bus(**options))  # type: ignore[arg-type]


def hexes(*texts: str) -> bytes:
    return b"".join(bytes.fromhex(text) for text in texts)


# --- published exchanges -----------------------------------------------------------------------


def test_published_pings() -> None:
    bus = make_bus(firmware=38)
    assert bus.feed(hexes("FFFFFD00010300 01 194E"), 0.0) == hexes(
        "FFFFFD00010700 55 00 060426 655D"
    )
    assert bus.feed(hexes("FFFFFD00FE0300 01 3142"), 0.0) == hexes(
        "FFFFFD00010700 55 00 060426 655D", "FFFFFD00020700 55 00 060426 6F6D"
    )


def test_published_read_write_and_sync_read() -> None:
    bus = make_bus(counts=(166, 2079))
    assert bus.feed(hexes("FFFFFD00010700 02 84000400 1D15"), 0.0) == hexes(
        "FFFFFD00010800 55 00 A6000000 8CC0"
    )
    assert bus.feed(hexes("FFFFFD00010900 03 740000020000 CA89"), 0.0) == hexes(
        "FFFFFD00010400 55 00 A10C"
    )
    assert bus.servos[0].table.get(reg.GOAL_POSITION) == 512
    assert bus.feed(hexes("FFFFFD00FE0900 82 840004000102 CEFA"), 0.0) == hexes(
        "FFFFFD00010800 55 00 A6000000 8CC0", "FFFFFD00020800 55 00 1F080000 BABE"
    )
    assert bus.feed(hexes("FFFFFD00FE1100 83 74000400 0196000000 02AA000000 8287"), 0.0) == b""
    assert [servo.table.get(reg.GOAL_POSITION) for servo in bus.servos] == [150, 170]


def test_published_reg_write_and_action() -> None:
    bus = make_bus()
    done = hexes("FFFFFD00010400 55 00 A10C")
    before = bus.servos[0].table.get(reg.GOAL_VELOCITY)
    assert bus.feed(hexes("FFFFFD00010900 04 6800C8000000 AE8E"), 0.0) == done
    assert bus.servos[0].table.get(reg.GOAL_VELOCITY) == before
    assert bus.servos[0].table.get(reg.REGISTERED_INSTRUCTION) == 1
    assert bus.feed(hexes("FFFFFD00010300 05 02CE"), 0.0) == done
    assert bus.servos[0].table.get(reg.GOAL_VELOCITY) == 200
    assert bus.servos[0].table.get(reg.REGISTERED_INSTRUCTION) == 0


@pytest.mark.parametrize(
    "request_packet",
    [
        "FFFFFD00010400 06 01 A1E6",
        "FFFFFD00010300 08 2F4E",
        "FFFFFD00010800 10 0144584C22 B1DC",
        "FFFFFD00010800 20 014354524C 16F5",
    ],
    ids=["factory reset", "reboot", "clear", "backup"],
)
def test_published_exchanges_that_end_with_a_bare_status(request_packet: str) -> None:
    bus = make_bus(model="XC330-T288")
    assert bus.feed(hexes(request_packet), 0.0) == hexes("FFFFFD00010400 55 00 A10C")


def test_published_bulk_read_and_bulk_write() -> None:
    bus = make_bus()
    bus.servos[0].health.voltage = 11.9
    bus.servos[1].health.temperature = 36.0
    assert bus.feed(hexes("FFFFFD00FE0D00 92 0190000200 0292000100 1A05"), 0.0) == hexes(
        "FFFFFD00010600 55 00 7700 C369", "FFFFFD00020500 55 00 24 8BA9"
    )
    bus.servos[0].table.set(reg.MAX_VOLTAGE_LIMIT, 150)
    bus.servos[1].table.set(reg.TEMPERATURE_LIMIT, 70)
    packet = hexes("FFFFFD00FE1000 93 0120000200A000 021F00010050 B768")
    assert bus.feed(packet, 0.0) == b""
    assert bus.servos[0].table.get(reg.MAX_VOLTAGE_LIMIT) == 160
    assert bus.servos[1].table.get(reg.TEMPERATURE_LIMIT) == 80


def test_published_fast_sync_read() -> None:
    bus = make_bus("XC330-T288", (3, 7, 4), counts=(166, 2079, 1023))
    request = hexes("FFFFFD00FE0A00 8A 84000400 030704 20F2")
    assert bus.feed(request, 0.0) == hexes(
        "FFFFFD00FE1900 55 00 03 A6000000 8408", "00 07 1F080000 16CA", "00 04 FF030000 D19E"
    )


def test_published_fast_bulk_read() -> None:
    bus = make_bus("XC330-T288", (3, 7, 4), counts=(166, 0, 0))
    bus.servos[2].health.temperature = 31.0
    pwm = bus.servos[1]
    pwm.table.set(reg.TORQUE_ENABLE, 1)
    bus.plant.current[1] = 421 / 885 * pwm.model.stall_current
    request = frame(BROADCAST, framing.FAST_BULK_READ, hexes("0384000400077C0002000492000100"))
    assert bus.feed(request, 0.0) == hexes(
        "FFFFFD00FE1400 55 00 03 A6000000 67A4", "00 07 A501 2474", "00 04 1F D9C1"
    )


# --- who answers, and when ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "answers"), [(0, (True, False, False)), (1, (True, True, False)), (2, (True,) * 3)]
)
def test_status_return_level(level: int, answers: tuple[bool, bool, bool]) -> None:
    c = client()
    c.write(reg.STATUS_RETURN_LEVEL, level, 1)
    replies = (
        c.send(1, framing.PING),
        c.send(1, framing.READ, struct.pack("<HH", reg.ID, 1)),
        c.send(1, framing.WRITE, struct.pack("<HB", reg.LED, 1)),
    )
    assert tuple(bool(reply) for reply in replies) == answers
    assert c.bus.servos[0].table.get(reg.LED) == 1


def test_a_shadow_id_obeys_and_never_answers() -> None:
    c = client()
    assert c.write(reg.SHADOW_ID, 9, 1, packet_id=2) == 0
    assert c.send(9, framing.WRITE, struct.pack("<HB", reg.LED, 1)) == b""
    assert c.send(9, framing.PING) == b""
    assert [servo.table.get(reg.LED) for servo in c.bus.servos] == [0, 1]


def test_a_new_id_takes_effect_after_the_reply_under_the_old_one() -> None:
    c = client()
    assert c.write(reg.ID, 40, 1) == 0
    assert c.send(1, framing.PING) == b""
    assert c.ask(framing.PING, packet_id=40)[0] == 0


def test_broadcast_reads_and_writes_are_not_answered() -> None:
    c = client()
    assert c.send(BROADCAST, framing.READ, struct.pack("<HH", 132, 4)) == b""
    assert c.send(BROADCAST, framing.WRITE, struct.pack("<HB", reg.LED, 1)) == b""
    assert all(servo.table.get(reg.LED) for servo in c.bus.servos)


def test_a_missing_servo_silences_those_named_after_it() -> None:
    c = client(ids=(1, 2, 3))
    packets = Parser().feed(
        c.send(BROADCAST, framing.SYNC_READ, struct.pack("<HH", 132, 4) + bytes((1, 9, 3))), 0.0
    )
    assert [packet.id for packet in packets] == [1]


def test_an_old_firmware_does_not_know_fast_reads() -> None:
    request = struct.pack("<HHBB", 132, 4, 1, 2)
    old = client(model="XL330-M288", firmware=45)
    assert old.send(BROADCAST, framing.FAST_SYNC_READ, request) == b""
    assert len(old.send(BROADCAST, framing.SYNC_READ, request)) == 2 * 15
    new = client(model="XL330-M288", firmware=46)
    assert len(new.send(BROADCAST, framing.FAST_SYNC_READ, request)) == 8 + 2 * 8


def test_fast_sync_read_is_not_stuffed() -> None:
    c = client(prepared=True)
    for servo in c.bus.servos:
        servo.table.memory[reg.GOAL_CURRENT : reg.GOAL_CURRENT + 6] = hexes("FFFFFDFFFFFF")
    span = struct.pack("<HHB", reg.GOAL_CURRENT, 6, 1)
    assert c.send(BROADCAST, framing.FAST_SYNC_READ, span)[8:-2] == hexes("0001 FFFFFDFFFFFF")
    assert c.send(BROADCAST, framing.SYNC_READ, span)[8:-2] == hexes("00 FFFFFDFDFFFFFF")


def test_a_damaged_packet_is_met_with_silence() -> None:
    damaged = bytearray(frame(1, framing.READ, struct.pack("<HH", 132, 4)))
    damaged[-1] ^= 1
    assert make_bus().feed(bytes(damaged), 0.0) == b""


def test_servos_at_another_rate_hear_nothing() -> None:
    c = client()
    ping = frame(BROADCAST, framing.PING)
    assert c.bus.feed(ping, c.t, baud=1_000_000) == b""
    assert len(c.bus.feed(ping, c.t, baud=57600)) == 28
    assert c.write(reg.BAUD_RATE, 3, 1, packet_id=2) == 0
    assert len(c.bus.feed(ping, c.t, baud=57600)) == 14
    assert len(c.bus.feed(ping, c.t, baud=1_000_000)) == 14


# --- access rights and limits ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "value", "size", "error"),
    [
        (reg.MODEL_NUMBER, 1, 2, framing.ACCESS),
        (reg.PRESENT_POSITION, 1, 4, framing.ACCESS),
        (14, 1, 1, framing.ACCESS),  # no such register
        (reg.GOAL_POSITION + 1, 1, 1, framing.ACCESS),  # within a register
        (reg.GOAL_POSITION, 1, 2, framing.DATA_LENGTH),
        (reg.TORQUE_ENABLE, 2, 1, framing.DATA_RANGE),
        (reg.BAUD_RATE, 8, 1, framing.DATA_RANGE),
        (reg.OPERATING_MODE, 2, 1, framing.DATA_RANGE),
        (reg.ID, 253, 1, framing.DATA_RANGE),
        (reg.GOAL_POSITION, 4096, 4, framing.DATA_LIMIT),
        (reg.GOAL_POSITION, -1, 4, framing.DATA_LIMIT),
        (reg.GOAL_VELOCITY, 331, 4, framing.DATA_LIMIT),
        (reg.GOAL_VELOCITY, -330, 4, framing.OK),
        (reg.GOAL_CURRENT, -1193, 2, framing.OK),
        (reg.GOAL_CURRENT, 1194, 2, framing.DATA_RANGE),
        (reg.MIN_POSITION_LIMIT, 4095, 4, framing.OK),
        (reg.LED, 1, 1, framing.OK),
        (660, 7, 1, framing.OK),  # indirect data of the second block
        (661, 0, 2, framing.ACCESS),  # past the end
    ],
)
def test_what_a_write_is_answered(address: int, value: int, size: int, error: int) -> None:
    c = client(model="XM430-W210")
    before = bytes(c.bus.servos[0].table.memory)
    assert c.write(address, value, size) == error
    if error:
        assert bytes(c.bus.servos[0].table.memory) == before


def test_configured_limits_bind() -> None:
    c = client()
    assert c.write(reg.CURRENT_LIMIT, 500, 2) == 0
    assert c.write(reg.GOAL_CURRENT, 501, 2) == framing.DATA_LIMIT
    assert c.write(reg.MAX_POSITION_LIMIT, 3000, 4) == 0
    assert c.write(reg.GOAL_POSITION, 3001, 4) == framing.DATA_LIMIT
    assert c.write(reg.MIN_POSITION_LIMIT, 3001, 4) == framing.DATA_LIMIT


def test_eeprom_is_locked_while_torque_is_on() -> None:
    c = client()
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == 0
    assert c.write(reg.RETURN_DELAY_TIME, 0, 1) == framing.ACCESS
    assert c.write(reg.TORQUE_ENABLE, 0, 1) == 0
    assert c.write(reg.RETURN_DELAY_TIME, 0, 1) == 0


def test_reading_past_the_table_and_reading_gaps() -> None:
    c = client()
    assert c.ask(framing.READ, struct.pack("<HH", 660, 3))[0] == framing.ACCESS
    assert c.ask(framing.READ, struct.pack("<HH", 14, 6)) == (0, bytes(6))


def test_unknown_instruction_and_action_without_one() -> None:
    c = client()
    assert c.ask(0x77)[0] == framing.INSTRUCTION_ERROR
    assert c.ask(framing.ACTION)[0] == framing.INSTRUCTION_ERROR


def test_a_model_without_current_sensing_has_no_current_registers() -> None:
    c = client(model="XL430-W250")
    assert c.write(reg.GOAL_CURRENT, 1, 2) == framing.ACCESS
    assert c.write(reg.OPERATING_MODE, reg.CURRENT_BASED_POSITION_MODE, 1) == framing.DATA_RANGE


@pytest.mark.parametrize("name", MODELS)
def test_factory_values(name: str) -> None:
    c = client(model=name)
    model = by_name(name)
    assert c.read(reg.MODEL_NUMBER, 2) == model.number
    assert c.read(reg.RETURN_DELAY_TIME, 1) & 0xFF == 250
    assert c.read(reg.OPERATING_MODE, 1) == reg.POSITION_MODE
    assert c.read(reg.VELOCITY_LIMIT, 4) == model.velocity_limit
    assert c.read(reg.POSITION_P_GAIN, 2) == model.position_gains[2]
    assert c.read(reg.TORQUE_ENABLE, 1) == 0
    first, data, _ = model.indirect_blocks(model.firmware)[0]
    assert c.read(first, 2) == data


# --- indirect addresses ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "firmware"), [("XM430-W210", 48), ("XL330-M288", 52), ("XL330-M288", 53)]
)
def test_indirect_data_stands_for_what_it_points_to(model: str, firmware: int) -> None:
    c = client(model=model, firmware=firmware, counts=(166, 0))
    address, data, _ = by_name(model).indirect_blocks(firmware)[0]
    for i, target in enumerate((reg.LED, *range(reg.PRESENT_POSITION, reg.PRESENT_POSITION + 4))):
        assert c.write(address + 2 * i, target, 2) == 0
    assert c.write(data, 1, 1) == 0
    assert c.bus.servos[0].table.get(reg.LED) == 1
    assert c.ask(framing.READ, struct.pack("<HH", data, 5)) == (0, hexes("01 A6000000"))
    assert c.write(data + 1, 5, 4) == framing.ACCESS  # present position is read-only
    assert c.write(address, 20, 2) == framing.DATA_RANGE  # EEPROM can't be pointed to


# --- torque, modes, motion ---------------------------------------------------------------------


def test_current_based_position_mode_moves_within_its_current() -> None:
    c = client(prepared=True)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_CURRENT, 100, 2)
    c.write(reg.GOAL_POSITION, 400, 4)
    currents = []
    for _ in range(200):
        c.later(0.005)
        currents.append(c.read(reg.PRESENT_CURRENT, 2))
    assert max(currents) <= 100
    assert abs(c.read(reg.PRESENT_POSITION, 4) - 400) <= 15
    assert c.read(reg.MOVING, 1) == 0


def test_torque_off_lets_go() -> None:
    c = client(prepared=True)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_POSITION, 300, 4)
    c.later(0.5)
    c.write(reg.TORQUE_ENABLE, 0, 1)
    before = c.read(reg.PRESENT_POSITION, 4)
    c.write(reg.GOAL_POSITION, 0, 4)
    c.later(0.5)
    assert abs(c.read(reg.PRESENT_POSITION, 4) - before) <= 1
    assert c.read(reg.PRESENT_CURRENT, 2) == 0


def test_current_mode_pushes_the_way_of_its_sign() -> None:
    c = client()
    c.write(reg.OPERATING_MODE, reg.CURRENT_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_CURRENT, -80, 2)
    c.later(0.3)
    assert c.read(reg.PRESENT_VELOCITY, 4) < 0
    assert c.read(reg.PRESENT_CURRENT, 2) == -80


def test_velocity_mode_keeps_its_speed() -> None:
    c = client()
    c.write(reg.OPERATING_MODE, reg.VELOCITY_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_VELOCITY, 60, 4)
    c.later(1.0)
    assert abs(c.read(reg.PRESENT_VELOCITY, 4) - 60) <= 2


def test_pwm_mode_runs_up_to_its_share_of_the_no_load_speed() -> None:
    c = client()
    c.write(reg.OPERATING_MODE, reg.PWM_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_PWM, 443, 2)
    c.later(2.0)
    speed = c.read(reg.PRESENT_VELOCITY, 4)
    assert 0.3 * 330 < speed < 0.5 * 330


def test_a_profile_takes_the_time_it_should() -> None:
    c = client()
    c.write(reg.PROFILE_VELOCITY, 50, 4)  # 11.45 rpm: 1024 counts take 1.31 s
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_POSITION, 1024, 4)
    c.later(0.65)
    half = c.read(reg.PRESENT_POSITION, 4)
    assert abs(half - 508) < 60
    assert c.read(reg.MOVING, 1) == 1
    c.later(0.9)
    assert abs(c.read(reg.PRESENT_POSITION, 4) - 1024) <= 5


def test_time_based_profile() -> None:
    c = client()
    c.write(reg.DRIVE_MODE, 4, 1)
    c.write(reg.PROFILE_VELOCITY, 2000, 4)  # ms
    c.write(reg.PROFILE_ACCELERATION, 500, 4)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_POSITION, 1000, 4)
    c.later(1.0)
    assert abs(c.read(reg.POSITION_TRAJECTORY, 4) - 500) < 10
    c.later(0.95)
    assert c.read(reg.MOVING_STATUS, 1) & 2
    c.later(0.1)
    assert c.read(reg.POSITION_TRAJECTORY, 4) == 1000


def test_a_mode_change_resets_goals_gains_and_profiles() -> None:
    c = client(counts=(700, 0))
    for address, value, size in (
        (reg.POSITION_P_GAIN, 5, 2),
        (reg.PROFILE_VELOCITY, 30, 4),
        (reg.GOAL_CURRENT, 3, 2),
        (reg.GOAL_PWM, 4, 2),
    ):
        assert c.write(address, value, size) == 0
    assert c.write(reg.OPERATING_MODE, reg.CURRENT_BASED_POSITION_MODE, 1) == 0
    assert c.read(reg.POSITION_P_GAIN, 2) == 800
    assert c.read(reg.PROFILE_VELOCITY, 4) == 0
    assert c.read(reg.GOAL_CURRENT, 2) == 1193
    assert c.read(reg.GOAL_PWM, 2) == 885
    assert c.read(reg.GOAL_POSITION, 4) == 700


def test_turns_are_kept_until_position_mode_or_clear() -> None:
    c = client(prepared=True)
    c.bus.plant.q[0] = 5000 * RADIAN
    assert c.read(reg.PRESENT_POSITION, 4) == 5000
    assert c.ask(framing.CLEAR, b"\x01DXL\x22")[0] == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 904
    c.bus.plant.q[0] = 9000 * RADIAN
    assert c.read(reg.PRESENT_POSITION, 4) == 4904
    assert c.write(reg.OPERATING_MODE, reg.POSITION_MODE, 1) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 808


def test_clear_fails_while_the_shaft_moves() -> None:
    c = client()
    c.bus.plant.dq[0] = 3.0
    assert c.ask(framing.CLEAR, b"\x01DXL\x22")[0] == framing.RESULT_FAIL


def test_homing_offset_and_reverse_mode() -> None:
    c = client(counts=(100, 0))
    assert c.write(reg.HOMING_OFFSET, -30, 4) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 70
    assert c.write(reg.DRIVE_MODE, 1, 1) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == -130


def test_realtime_tick_wraps() -> None:
    c = client()
    c.later(32.766 - c.t)
    assert c.read(reg.REALTIME_TICK, 2) == 32766
    c.later(0.003)
    assert c.read(reg.REALTIME_TICK, 2) == 1


# --- bus watchdog ------------------------------------------------------------------------------


def test_bus_watchdog_stops_and_locks_the_goals_until_zero_is_written() -> None:
    c = client(prepared=True)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.BUS_WATCHDOG, 5, 1)
    c.write(reg.GOAL_CURRENT, 40, 2)
    c.write(reg.GOAL_POSITION, 4000, 4)
    for _ in range(20):  # packets keep it going
        c.later(0.09)
        assert c.read(reg.BUS_WATCHDOG, 1) == 5
    assert c.bus.plant.dq[0] > 0.0
    c.later(0.11)
    assert c.bus.servos[0].table.memory[reg.BUS_WATCHDOG] == 0xFF
    c.later(0.5)
    stood = c.read(reg.PRESENT_POSITION, 4)
    assert c.bus.plant.dq[0] == 0.0
    assert c.read(reg.TORQUE_ENABLE, 1) == 1
    assert c.write(reg.GOAL_POSITION, 10, 4) == framing.DATA_RANGE
    assert c.write(reg.BUS_WATCHDOG, 5, 1) == framing.DATA_RANGE
    assert c.write(reg.BUS_WATCHDOG, 0, 1) == 0
    assert c.write(reg.GOAL_POSITION, stood + 10, 4) == 0


def test_bus_watchdog_sleeps_while_torque_is_off() -> None:
    c = client()
    c.write(reg.BUS_WATCHDOG, 1, 1)
    c.later(5.0)
    assert c.read(reg.BUS_WATCHDOG, 1) == 1


# --- hardware errors ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "bit"), [("overheat=1", 2), ("overload=1", 5), ("undervoltage=1", 0)]
)
def test_hardware_errors_shut_down_until_a_reboot(fault: str, bit: int) -> None:
    c = client(model="XL330-M288")  # its shutdown mask has all three
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.bus.fault(fault, c.t)
    c.later(0.02)
    error, data = c.ask(framing.READ, struct.pack("<HH", reg.HARDWARE_ERROR_STATUS, 1))
    assert error == framing.ALERT
    assert data[0] == 1 << bit
    assert c.bus.servos[0].torque_on is False
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == framing.ALERT | framing.RESULT_FAIL
    c.bus.fault("recover=1", c.t)
    assert c.ask(framing.REBOOT)[0] == framing.ALERT
    assert c.send(1, framing.PING) == b""
    c.later(REBOOT_TIME)
    assert c.read(reg.HARDWARE_ERROR_STATUS, 1) == 0
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == 0


def test_an_error_outside_the_shutdown_mask_only_alerts() -> None:
    c = client()  # XM430: mask 52 lacks the voltage bit
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.bus.fault("undervoltage=1", c.t)
    c.later(0.02)
    assert c.write(reg.LED, 1, 1) == framing.ALERT
    assert c.bus.servos[0].torque_on is True


def test_overload_after_its_time_at_the_current_limit() -> None:
    c = client()
    c.write(reg.CURRENT_LIMIT, 30, 2)
    c.write(reg.OPERATING_MODE, reg.CURRENT_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_CURRENT, 30, 2)
    c.later(OVERLOAD_TIME - 0.1)
    assert c.read(reg.HARDWARE_ERROR_STATUS, 1) == 0
    c.later(0.3)
    assert c.bus.servos[0].table.memory[reg.HARDWARE_ERROR_STATUS] == 1 << 5
    assert c.bus.servos[0].torque_on is False


# --- reboot, reset, backup ---------------------------------------------------------------------


def test_reboot_resets_ram_and_keeps_eeprom() -> None:
    c = client(counts=(1234, 0))
    for address, value, size in (
        (reg.RETURN_DELAY_TIME, 3, 1),
        (reg.LED, 1, 1),
        (reg.PROFILE_VELOCITY, 9, 4),
        (reg.TORQUE_ENABLE, 1, 1),
    ):
        assert c.write(address, value, size) == 0
    c.ask(framing.REBOOT)
    c.later(REBOOT_TIME - 0.01)
    assert c.send(1, framing.PING) == b""
    c.later(0.01)
    assert c.read(reg.RETURN_DELAY_TIME, 1) == 3
    assert (
        c.read(reg.LED, 1) == c.read(reg.PROFILE_VELOCITY, 4) == c.read(reg.TORQUE_ENABLE, 1) == 0
    )
    assert c.read(reg.GOAL_POSITION, 4) == 1234


@pytest.mark.parametrize(
    ("option", "new_id", "baud"), [(0xFF, 1, 1), (1, 5, 1), (2, 5, 3)], ids=["all", "id", "baud"]
)
def test_factory_reset(option: int, new_id: int, baud: int) -> None:
    c = client(ids=(5, 6))
    c.write(reg.BAUD_RATE, 3, 1, packet_id=5)
    c.write(reg.RETURN_DELAY_TIME, 3, 1, packet_id=5)
    assert c.ask(framing.FACTORY_RESET, bytes((option,)), packet_id=5)[0] == 0
    c.later(REBOOT_TIME)
    assert c.read(reg.BAUD_RATE, 1, packet_id=new_id) == baud
    assert c.read(reg.RETURN_DELAY_TIME, 1, packet_id=new_id) & 0xFF == 250


def test_a_broadcast_factory_reset_of_everything_is_ignored() -> None:
    c = client(ids=(5, 6))
    assert c.send(BROADCAST, framing.FACTORY_RESET, b"\xff") == b""
    assert c.ask(framing.PING, packet_id=5)[0] == 0
    assert c.ask(framing.FACTORY_RESET, b"\x07", packet_id=5)[0] == framing.DATA_RANGE


def test_backup_and_restore() -> None:
    c = client()
    store, restore = b"\x01CTRL", b"\x02CTRL"
    assert c.ask(framing.BACKUP, restore)[0] == framing.RESULT_FAIL  # nothing stored yet
    c.write(reg.RETURN_DELAY_TIME, 11, 1)
    c.write(reg.STARTUP_CONFIGURATION, 2, 1)
    c.write(reg.POSITION_P_GAIN, 321, 2)
    assert c.ask(framing.BACKUP, store)[0] == 0
    assert c.read(reg.BACKUP_READY, 1) == 1
    c.write(reg.RETURN_DELAY_TIME, 99, 1)
    assert c.ask(framing.BACKUP, restore)[0] == 0
    c.later(REBOOT_TIME)
    assert c.read(reg.RETURN_DELAY_TIME, 1) == 11
    assert c.read(reg.POSITION_P_GAIN, 2) == 321  # RAM too, as the startup configuration asks
    c.write(reg.TORQUE_ENABLE, 1, 1)
    assert c.ask(framing.BACKUP, store)[0] == framing.RESULT_FAIL


# --- faults on demand --------------------------------------------------------------------------


def test_reply_faults_do_what_they_say_and_are_seeded() -> None:
    def replies(fault: str) -> list[bytes]:
        bus = make_bus()
        bus.fault(fault, 0.0)
        ping = frame(1, framing.PING)
        return [bus.feed(ping, 0.001 * i) for i in range(400)]

    whole = make_bus().feed(frame(1, framing.PING), 0.0)
    dropped = replies("drop=0.25")
    assert 60 < dropped.count(b"") < 140
    assert set(dropped) == {b"", whole}
    assert all(reply == whole[: len(reply)] for reply in replies("truncate=1"))
    assert set(replies("duplicate=1")) == {whole + whole}
    for reply in replies("corrupt=1"):
        flipped = int.from_bytes(reply, "big") ^ int.from_bytes(whole, "big")
        assert flipped.bit_count() == 1
    assert replies("drop=0.25") == dropped
    late = make_bus()
    late.fault("late=1", 0.0)
    assert late.exchange(frame(1, framing.PING), 0.0)[0].late > 0.0


def test_a_silent_servo_comes_back() -> None:
    c = client()
    c.bus.fault("silent=2", c.t)
    assert c.send(2, framing.PING) == b""
    assert c.send(1, framing.PING) != b""
    c.bus.fault("answer=2", c.t)
    assert c.send(2, framing.PING) != b""


@pytest.mark.parametrize("text", ["drop", "drop=2", "drop=x", "melt=1", "silent=7", "reboot=1.5"])
def test_faults_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(FaultError):
        make_bus().fault(text, 0.0)


# --- the hand's mapping ------------------------------------------------------------------------


def test_directions_and_zeros_of_the_settings() -> None:
    plant = FreeJoints(2)
    plant.q[:] = 0.3
    bus = ServoBus.from_settings(Settings(), plant)
    c = Client(bus)
    turn = round(0.3 / RADIAN)
    assert c.read(reg.PRESENT_POSITION, 4, 1) == 2048 + turn
    assert c.read(reg.PRESENT_POSITION, 4, 2) == 2048 - turn
    assert c.read(reg.OPERATING_MODE, 1, 2) == reg.CURRENT_BASED_POSITION_MODE
    with pytest.raises(ValueError, match="no 4500000 baud"):
        hand_bus(servos={"model": "XL330-M288"}, baud=4_500_000)


def test_the_same_run_twice_is_the_same_to_the_bit() -> None:
    def run() -> tuple[bytes, bytes]:
        c = client(prepared=True)
        out = b""
        c.write(reg.TORQUE_ENABLE, 1, 1)
        for i in range(200):
            c.write(reg.GOAL_POSITION, 300 + i % 7, 4)
            c.later(0.002)
            out += c.send(BROADCAST, framing.FAST_SYNC_READ, struct.pack("<HHBB", 120, 27, 1, 2))
        return out, np.array(c.bus.plant.q).tobytes()

    assert run() == run()


# --- anything at all ---------------------------------------------------------------------------


@settings(max_examples=150)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 1, 2, 9, BROADCAST]),
            st.integers(0, 255),
            st.one_of(
                st.binary(max_size=30),
                st.builds(
                    lambda address, body: address.to_bytes(2, "little") + body,
                    st.integers(0, 700),
                    st.binary(max_size=24),
                ),
            ),
        ),
        max_size=12,
    )
)
def test_any_packets_are_survived_and_answered_in_form(
    packets: list[tuple[int, int, bytes]],
) -> None:
    bus = make_bus()
    for step, content in enumerate(packets):
        reply = bus.feed(frame(*content), step * 0.02)
        if content[1] not in (framing.FAST_SYNC_READ, framing.FAST_BULK_READ):
            parser = Parser()
            found = parser.feed(reply, 0.0)
            assert sum(packet.size for packet in found) == len(reply)
            assert all(p.valid and p.instruction == framing.STATUS for p in found)


def test_thousands_of_mutated_packets_neither_crash_nor_hang() -> None:
    report = fuzz(6000, seed=5)
    assert report.packets > 1000
    assert report.alive
