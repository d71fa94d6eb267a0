"""Test an emulated servo's registers, motion, watchdog, errors and resets."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.servos.joint import JointScale
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST
from softfinger.daemon.simulation.servo_model.servo import OVERLOAD_TIME, REBOOT_TIME
from softfinger.daemon.simulation.servo_model.servo_joint import Profile
from tests.harness.servos import RADIAN, BusClient


@pytest.mark.parametrize(
    ("address", "value", "size", "error"),
    [
        (reg.MODEL_NUMBER, 1, 2, framing.ACCESS),
        (reg.PRESENT_POSITION, 1, 4, framing.ACCESS),
        (14, 1, 1, framing.ACCESS),  # The register does not exist.
        (reg.GOAL_POSITION + 1, 1, 1, framing.ACCESS),  # The address is inside a register.
        (reg.GOAL_POSITION, 1, 2, framing.DATA_LENGTH),
        (reg.TORQUE_ENABLE, 2, 1, framing.DATA_RANGE),
        (reg.BAUD_RATE, 8, 1, framing.DATA_RANGE),
        (reg.OPERATING_MODE, 2, 1, framing.DATA_RANGE),
        (reg.OPERATING_MODE, reg.PWM_MODE, 1, framing.DATA_RANGE),
        (reg.STARTUP_CONFIGURATION, 4, 1, framing.DATA_RANGE),
        (reg.ID, 253, 1, framing.DATA_RANGE),
        (reg.GOAL_POSITION, 4096, 4, framing.DATA_LIMIT),
        (reg.GOAL_POSITION, -1, 4, framing.DATA_LIMIT),
        (reg.GOAL_VELOCITY, 331, 4, framing.DATA_LIMIT),
        (reg.GOAL_VELOCITY, -330, 4, framing.OK),
        (reg.GOAL_CURRENT, -1193, 2, framing.OK),
        (reg.GOAL_CURRENT, 1194, 2, framing.DATA_RANGE),
        (reg.MIN_POSITION_LIMIT, 4095, 4, framing.OK),
        (reg.LED, 1, 1, framing.OK),
        (660, 7, 1, framing.OK),  # in the second block of indirect data
        (661, 0, 2, framing.ACCESS),  # past the end of the table
    ],
)
def test_status_errors_of_writes(address: int, value: int, size: int, error: int) -> None:
    c = BusClient(model="XM430-W210")
    before = bytes(c.bus.servos[0].table.memory)
    assert c.write(address, value, size) == error
    if error:
        assert bytes(c.bus.servos[0].table.memory) == before


def test_configured_limits_are_enforced() -> None:
    c = BusClient()
    assert c.write(reg.CURRENT_LIMIT, 500, 2) == 0
    assert c.write(reg.GOAL_CURRENT, 501, 2) == framing.DATA_LIMIT
    assert c.write(reg.MAX_POSITION_LIMIT, 3000, 4) == 0
    assert c.write(reg.GOAL_POSITION, 3001, 4) == framing.DATA_LIMIT
    assert c.write(reg.MIN_POSITION_LIMIT, 3001, 4) == framing.DATA_LIMIT


@pytest.mark.parametrize(
    ("model", "lowest"), [("XL330-M288", 31), ("XC330-M181", 31), ("XC330-T288", 55)]
)
def test_voltage_limits_start_at_the_bound_in_the_manual(model: str, lowest: int) -> None:
    c = BusClient(model=model)
    assert c.write(reg.MIN_VOLTAGE_LIMIT, lowest - 1, 2) == framing.DATA_RANGE
    assert c.write(reg.MIN_VOLTAGE_LIMIT, lowest, 2) == framing.OK


def test_eeprom_is_locked_while_torque_is_on() -> None:
    c = BusClient()
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == 0
    assert c.write(reg.RETURN_DELAY_TIME, 0, 1) == framing.ACCESS
    assert c.write(reg.TORQUE_ENABLE, 0, 1) == 0
    assert c.write(reg.RETURN_DELAY_TIME, 0, 1) == 0


@pytest.mark.parametrize(
    ("instruction", "parameters"),
    [
        (0x77, b""),
        (0x05, b""),  # The action instruction has no registered write.
        (0x20, b"\x01CTRL"),  # control table backup
    ],
)
def test_unknown_instructions_are_refused(instruction: int, parameters: bytes) -> None:
    c = BusClient()
    before = bytes(c.bus.servos[0].table.memory)
    assert c.ask(instruction, parameters) == (framing.INSTRUCTION_ERROR, b"")
    assert bytes(c.bus.servos[0].table.memory) == before


def test_a_registered_write_waits_for_the_action() -> None:
    c = BusClient()
    led = struct.pack("<HB", reg.LED, 1)
    assert c.ask(framing.REG_WRITE, led) == (framing.OK, b"")
    assert (c.read(reg.LED, 1), c.read(reg.REGISTERED_INSTRUCTION, 1)) == (0, 1)
    assert c.ask(framing.REG_WRITE, struct.pack("<HB", reg.LED, 2)) == (framing.DATA_RANGE, b"")
    assert c.send(framing.BROADCAST, framing.ACTION) == b""
    assert (c.read(reg.LED, 1), c.read(reg.REGISTERED_INSTRUCTION, 1)) == (1, 0)
    assert c.ask(framing.ACTION) == (framing.INSTRUCTION_ERROR, b"")
    c.ask(framing.REG_WRITE, struct.pack("<HB", reg.LED, 0))
    c.ask(framing.REBOOT)
    c.later(REBOOT_TIME + 0.01)
    assert c.ask(framing.ACTION) == (framing.INSTRUCTION_ERROR, b"")


def test_a_shadow_id_is_executed_without_a_reply() -> None:
    c = BusClient()
    assert c.write(reg.SHADOW_ID, 2, 1) == 0
    assert c.write(reg.LED, 1, 1, packet_id=2) == 0  # The packet is addressed to servo 2.
    assert [servo.table.get(reg.LED) for servo in c.bus.servos] == [1, 1]


def test_the_factory_shadow_id_is_not_an_id() -> None:
    c = BusClient()
    item = struct.pack("<HH", reg.LED, 1) + bytes((255, 1))
    assert c.send(framing.BROADCAST, framing.SYNC_WRITE, item) == b""
    assert not any(servo.table.get(reg.LED) for servo in c.bus.servos)


def test_torque_on_at_power_up_if_configured() -> None:
    c = BusClient()
    assert c.write(reg.STARTUP_CONFIGURATION, 1, 1) == 0
    c.ask(framing.REBOOT)
    c.later(REBOOT_TIME + 0.01)
    assert c.bus.servos[0].torque_on


def test_protocol_1_if_configured() -> None:
    c = BusClient()
    c.bus.servos[0].table.set(reg.PROTOCOL_TYPE, 1)
    assert c.send(1, framing.PING) == b""
    # The packet is an example from the e-Manual's page on Protocol 1.0.
    asked, answered = bytes.fromhex("FFFF010201FB"), bytes.fromhex("FFFF010200FC")
    assert c.bus.feed(asked, c.t) == answered
    assert c.bus.feed(bytes.fromhex("FFFF020201FA"), c.t) == b""
    assert c.bus.feed(bytes.fromhex("FFFF010201FA"), c.t) == b""  # The checksum is wrong.


# Registers that affect how the servo moves to its goal.


def travelled(*writes: tuple[int, int, int], time: float = 0.1) -> float:
    """Return the distance [counts] that a servo moves in ``time`` [s] if its goal is at 300."""
    c = BusClient(for_daemon=True)
    for address, value, size in writes:
        assert c.write(address, value, size) == 0
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == 0
    assert c.write(reg.GOAL_POSITION, 300, 4) == 0
    c.later(time)
    return abs(c.read(reg.PRESENT_POSITION, 4))


@pytest.mark.parametrize(
    ("address", "value", "size", "share"),
    [
        (reg.POSITION_P_GAIN, 80, 2, 0.6),  # The gain is a tenth of the factory setting.
        (reg.POSITION_D_GAIN, 16_000, 2, 0.6),
        (reg.GOAL_PWM, 6, 2, 0.6),
        (reg.PWM_LIMIT, 6, 2, 0.6),
        (reg.PROFILE_VELOCITY, 5, 4, 0.1),
    ],
)
def test_gains_pwm_and_profile_slow_a_joint(address, value, size, share) -> None:
    assert travelled() > 200.0
    assert travelled((address, value, size)) < share * travelled()


def test_without_position_gain_or_pwm_the_joint_does_not_move() -> None:
    assert travelled((reg.POSITION_P_GAIN, 0, 2)) <= 1
    assert travelled((reg.GOAL_PWM, 0, 2)) <= 1


def test_the_velocity_limit_applies_to_profile_and_velocity_mode() -> None:
    profile = (reg.PROFILE_VELOCITY, 200, 4)
    limited = travelled((reg.VELOCITY_LIMIT, 20, 4), profile)
    # The joint lags behind the profile, so the distance is shorter than at 20 · 0.229 rpm.
    assert limited < 20 * 0.229 / 60.0 * 4096 * 0.1 < travelled(profile)
    assert travelled((reg.VELOCITY_LIMIT, 0, 4), profile) <= 1
    c = BusClient()
    for address, value, size in (
        (reg.OPERATING_MODE, reg.VELOCITY_MODE, 1),
        (reg.TORQUE_ENABLE, 1, 1),
        (reg.GOAL_VELOCITY, 100, 4),
    ):
        assert c.write(address, value, size) == 0
    c.bus.servos[0].table.set(reg.VELOCITY_LIMIT, 10)
    c.later(1.0)
    assert c.read(reg.PRESENT_POSITION, 4) == pytest.approx(10 * 0.229 / 60.0 * 4096, rel=0.1)


@pytest.mark.parametrize(
    ("model", "firmware"), [("XM430-W210", 48), ("XL330-M288", 52), ("XL330-M288", 53)]
)
def test_indirect_data_is_redirected_to_its_address(model: str, firmware: int) -> None:
    c = BusClient(model=model, firmware=firmware, counts=(166, 0))
    address, data, _ = by_name(model).indirect_blocks(firmware)[0]
    for i, target in enumerate((reg.LED, *range(reg.PRESENT_POSITION, reg.PRESENT_POSITION + 4))):
        assert c.write(address + 2 * i, target, 2) == 0
    assert c.write(data, 1, 1) == 0
    assert c.bus.servos[0].table.get(reg.LED) == 1
    assert c.ask(framing.READ, struct.pack("<HH", data, 5)) == (0, bytes.fromhex("01 A6000000"))
    assert c.write(data + 1, 5, 4) == framing.ACCESS  # The present position is read-only.
    # Indirect addresses must not refer to EEPROM.
    assert c.write(address, 20, 2) == framing.DATA_RANGE


def test_velocity_mode_keeps_its_velocity() -> None:
    c = BusClient()
    c.write(reg.OPERATING_MODE, reg.VELOCITY_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_VELOCITY, 60, 4)
    c.later(1.0)
    assert abs(c.read(reg.PRESENT_VELOCITY, 4) - 60) <= 2


def test_a_velocity_based_profile_takes_the_expected_time() -> None:
    c = BusClient()
    c.write(reg.PROFILE_VELOCITY, 50, 4)  # At 11.45 rpm, 1024 counts take 1.31 s.
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_POSITION, 1024, 4)
    c.later(0.65)
    half = c.read(reg.PRESENT_POSITION, 4)
    assert abs(half - 508) < 60
    assert c.read(reg.MOVING, 1) == 1
    c.later(0.9)
    assert abs(c.read(reg.PRESENT_POSITION, 4) - 1024) <= 5


def test_a_time_based_profile_takes_the_expected_time() -> None:
    c = BusClient()
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
    c = BusClient(counts=(700, 0))
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
    c = BusClient(for_daemon=True)
    c.bus.plant.q[0] = 5000 * RADIAN
    assert c.read(reg.PRESENT_POSITION, 4) == 5000
    assert c.ask(framing.CLEAR, b"\x01DXL\x22")[0] == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 904
    c.bus.plant.q[0] = 9000 * RADIAN
    assert c.read(reg.PRESENT_POSITION, 4) == 4904
    assert c.write(reg.OPERATING_MODE, reg.POSITION_MODE, 1) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 808
    c.bus.plant.dq[0] = 3.0
    assert c.ask(framing.CLEAR, b"\x01DXL\x22")[0] == framing.RESULT_FAIL


def test_homing_offset_and_reverse_mode() -> None:
    c = BusClient(counts=(100, 0))
    assert c.write(reg.HOMING_OFFSET, -30, 4) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == 70
    assert c.write(reg.DRIVE_MODE, 1, 1) == 0
    assert c.read(reg.PRESENT_POSITION, 4) == -130


def test_realtime_tick_wraps() -> None:
    c = BusClient()
    c.later(32.766 - c.t)
    assert c.read(reg.REALTIME_TICK, 2) == 32766
    c.later(0.003)
    assert c.read(reg.REALTIME_TICK, 2) == 1


def test_a_watchdog_trip_stops_motion_and_locks_goals_until_zero_is_written() -> None:
    c = BusClient(for_daemon=True)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.BUS_WATCHDOG, 5, 1)
    c.write(reg.GOAL_CURRENT, 40, 2)
    c.write(reg.GOAL_POSITION, 4000, 4)
    for _ in range(20):  # Regular packets keep the watchdog from tripping.
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
    assert c.write(reg.TORQUE_ENABLE, 0, 1) == 0
    c.write(reg.BUS_WATCHDOG, 1, 1)  # The watchdog is inactive while torque is off.
    c.later(5.0)
    assert c.read(reg.BUS_WATCHDOG, 1) == 1


@pytest.mark.parametrize(("fault", "bit"), [("overheat", 2), ("overload", 5), ("undervoltage", 0)])
def test_hardware_errors_disable_torque_until_a_reboot(fault: str, bit: int) -> None:
    c = BusClient(model="XL330-M288")  # The model's shutdown mask includes all three errors.
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.bus.fault(fault, 1, c.t)
    c.later(0.02)
    error, data = c.ask(framing.READ, struct.pack("<HH", reg.HARDWARE_ERROR_STATUS, 1))
    assert error == framing.ALERT
    assert data[0] == 1 << bit
    assert c.bus.servos[0].torque_on is False
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == framing.ALERT | framing.RESULT_FAIL
    c.bus.fault("recover", 1, c.t)
    assert c.ask(framing.REBOOT)[0] == framing.ALERT
    assert c.send(1, framing.PING) == b""
    c.later(REBOOT_TIME)
    assert c.read(reg.HARDWARE_ERROR_STATUS, 1) == 0
    assert c.write(reg.TORQUE_ENABLE, 1, 1) == 0


def test_an_error_outside_the_shutdown_mask_only_sets_the_alert() -> None:
    c = BusClient()  # The XM430's mask of 52 excludes the voltage bit.
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.bus.fault("undervoltage", 1, c.t)
    c.later(0.02)
    assert c.write(reg.LED, 1, 1) == framing.ALERT
    assert c.bus.servos[0].torque_on is True


def test_overload_after_the_allowed_time_at_the_current_limit() -> None:
    c = BusClient()
    c.write(reg.CURRENT_LIMIT, 30, 2)
    c.write(reg.OPERATING_MODE, reg.CURRENT_MODE, 1)
    c.write(reg.TORQUE_ENABLE, 1, 1)
    c.write(reg.GOAL_CURRENT, 30, 2)
    c.later(OVERLOAD_TIME - 0.1)
    assert c.read(reg.HARDWARE_ERROR_STATUS, 1) == 0
    c.later(0.3)
    assert c.bus.servos[0].table.memory[reg.HARDWARE_ERROR_STATUS] == 1 << 5
    assert c.bus.servos[0].torque_on is False


def test_reboot_resets_ram_and_keeps_eeprom() -> None:
    c = BusClient(counts=(1234, 0))
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


@given(
    direction=st.sampled_from([-1, 1]),
    zero=st.integers(-5000, 5000),
    ratio=st.floats(0.1, 50.0),
    counts=st.integers(-100_000, 100_000),
)
def test_unit_conversions_are_inverse(direction: int, zero: int, ratio: float, counts: int) -> None:
    servos = ServoSettings(direction=(direction, direction), zero=(zero, zero), gear_ratio=ratio)
    scale = JointScale.of(servos, 1, by_name(servos.model))
    assert scale.position_counts(scale.angle(counts)) == counts
    assert scale.velocity_counts(scale.rate(counts)) == counts
    assert scale.current_counts(scale.amperes(counts)) == counts
    assert scale.angle(zero) == 0.0
    turn = scale.angle(zero + direction * 4096)
    assert turn == pytest.approx(2.0 * math.pi / ratio)
    assert scale.bound_counts(-5 * 2.69e-3) == 5


@pytest.mark.parametrize(
    ("option", "new_id", "baud"), [(0xFF, 1, 1), (1, 5, 1), (2, 5, 3)], ids=["all", "id", "baud"]
)
def test_factory_reset_options(option: int, new_id: int, baud: int) -> None:
    c = BusClient(ids=(5, 6))
    c.write(reg.BAUD_RATE, 3, 1, packet_id=5)
    c.write(reg.RETURN_DELAY_TIME, 3, 1, packet_id=5)
    assert c.ask(framing.FACTORY_RESET, bytes((option,)), packet_id=5)[0] == 0
    c.later(REBOOT_TIME)
    assert c.read(reg.BAUD_RATE, 1, packet_id=new_id) == baud
    assert c.read(reg.RETURN_DELAY_TIME, 1, packet_id=new_id) & 0xFF == 250


def test_a_broadcast_full_factory_reset_is_ignored() -> None:
    c = BusClient(ids=(5, 6))
    assert c.send(BROADCAST, framing.FACTORY_RESET, b"\xff") == b""
    assert c.ask(framing.PING, packet_id=5)[0] == 0
    assert c.ask(framing.FACTORY_RESET, b"\x07", packet_id=5)[0] == framing.DATA_RANGE


@settings(max_examples=40)
@given(
    start=st.floats(-1000, 1000),
    target=st.floats(-1000, 1000),
    speed=st.floats(500, 5000),
    acceleration=st.floats(500, 1e5),
)
def test_a_profile_arrives_within_its_limits_without_overshoot(start, target, speed, acceleration):
    profile = Profile()
    profile.hold(start)
    profile.aim(target, speed, acceleration)
    dt = 0.001
    ideal = abs(target - start) / speed + speed / acceleration
    last_velocity, steps = 0.0, 0
    while profile.busy:
        before = profile.position
        profile.step(dt)
        steps += 1
        low, high = sorted((start, target))
        assert low - 1e-6 <= profile.position <= high + 1e-6
        assert abs(profile.position - before) <= speed * dt * (1 + 1e-9)
        if profile.busy:
            assert abs(profile.velocity - last_velocity) <= acceleration * dt * (1 + 1e-6)
        last_velocity = profile.velocity
        assert steps * dt <= 1.05 * ideal + 0.05
    assert profile.position == target
