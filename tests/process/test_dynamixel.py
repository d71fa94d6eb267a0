"""Test the Dynamixel backend, with the real SDK and pyserial, on emulated servos behind a pty."""

import math
import struct
import time
from collections import deque

import pytest
from dynamixel_sdk.robotis_def import COMM_RX_TIMEOUT

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import SafetySettings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.protocol import ServoLine
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus, TimedReply
from softfinger.daemon.types import Goal, Reading
from tests.conftest import until
from tests.harness.servos import RADIAN, backend_settings, lasting_notices, make_bus

FIRMWARES = pytest.mark.parametrize("firmware", [44, 48], ids=["sync read", "fast sync read"])


def placed(firmware: int, *counts: int) -> ServoBus:
    """Return servos configured for the hand, with the given firmware and positions [counts]."""
    return make_bus("XM430-W350", firmware=firmware, for_daemon=True, counts=counts)


def read(backend: DynamixelServos) -> Reading:
    reading = Reading()
    backend.read(reading)
    return reading


# --- reading and writing -----------------------------------------------------------------------


@FIRMWARES
def test_readings_match_the_servos(running, firmware, connect):
    now = time.monotonic()
    bus = running(placed(firmware, 2048, 2048))
    backend = connect(bus, zero=(2048, 2048))

    def place() -> None:
        bus.bus.plant.q[:] = (2048 + 100) * RADIAN, (2048 - 50) * RADIAN
        bus.bus.plant.current[:] = 100 * 2.69e-3, -7 * 2.69e-3

    bus.call(place)
    reading = read(backend)
    assert reading.valid
    assert reading.seq == 1
    assert reading.t >= now
    assert reading.alert == 0
    # The direction is +1 for the left joint and −1 for the right joint.
    assert reading.q == pytest.approx([100 * RADIAN, 50 * RADIAN])
    assert [bool(each.text) for each in lasting_notices(backend)] == [True] * (
        2 if firmware == 44 else 0
    )


def test_torque_on_starts_at_the_current_position(bus, connect):
    def place() -> None:
        bus.bus.plant.q[:] = (0.4, -0.3)
        for servo in bus.bus.servos:
            servo.table.set(reg.GOAL_POSITION, 0)
            servo.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR)

    bus.call(place)
    backend = connect(bus)
    assert (
        sum("bus watchdog has stopped the servo" in notice for notice in map(str, backend.notices))
        == 2
    )
    backend.torque_on()
    for i, direction in ((0, 1), (1, -1)):
        memory = bus.memory(i)
        goal = struct.unpack_from("<i", memory, reg.GOAL_POSITION)[0]
        expected = 2048 + direction * round((0.4, -0.3)[i] / RADIAN)
        assert goal == expected
        assert struct.unpack_from("<h", memory, reg.GOAL_CURRENT)[0] == 0
        assert memory[reg.TORQUE_ENABLE] == 1
        assert memory[reg.BUS_WATCHDOG] == 100  # in units of 0.02 s
    assert read(backend).q == pytest.approx([0.4, -0.3], abs=RADIAN)
    assert backend.torque_off(Reading())
    assert all(bus.memory(i)[reg.TORQUE_ENABLE] == 0 for i in (0, 1))
    # The servos do not acknowledge the write, so wait until the register changes.
    until(lambda: all(bus.memory(i)[reg.BUS_WATCHDOG] == 0 for i in (0, 1)))


def test_torque_on_waits_for_a_moving_joint(bus, connect, monkeypatch):
    backend = connect(bus)
    ways = [0.2, 0.1, 0.05]
    really = ServoLine.store

    def store(line, address, values):
        failed = really(line, address, values)
        if address == reg.GOAL_POSITION and ways:
            way = ways.pop()
            bus.call(lambda: bus.bus.plant.q.__iadd__(way))
        return failed

    monkeypatch.setattr(ServoLine, "store", store)
    backend.torque_on()
    for servo in bus.report():
        assert servo["torque"]
        assert servo["torque_on"]["farthest"] < 0.01


def test_torque_on_is_refused_outside_the_joint_range(bus, connect):
    bus.call(lambda: bus.bus.plant.q.__setitem__(1, 4.0))
    backend = connect(bus)
    assert [n for n in map(str, backend.notices) if "servo 2 (right): the joint is at 229°" in n]
    with pytest.raises(ServoError, match=r"(?s)servo 2 .*229°, expected -29°.*calibrate joints"):
        backend.torque_on()
    assert not bus.servo(0).torque_on
    assert not bus.servo(1).torque_on


@pytest.mark.parametrize(
    ("model", "level"), [("XM430-W350", 2), ("XL330-M288", 1), ("XC330-T288", 2)]
)
def test_joints_follow_their_goals(running, model, level):
    bus = running(servos={"model": model})
    bus.call(lambda: [s.table.set(reg.STATUS_RETURN_LEVEL, level) for s in bus.bus.servos])
    safety = SafetySettings(current_max=by_name(model).stall_current, current_move=0.1)
    settings = backend_settings(bus.port, model=model).model_copy(update={"safety": safety})
    backend = DynamixelServos(settings, RealClock())
    backend.connect()
    backend.torque_on()
    goal, reading = Goal(q=[0.3, -0.2], current=[0.5, 0.5]), Reading()

    def there() -> bool:
        backend.read(reading)
        backend.write(goal)
        return reading.q == pytest.approx(goal.q, abs=0.01)

    until(there)
    assert reading.valid
    counters = backend.counters()
    counters.pop("timeouts")  # Timeouts may occur on a busy machine.
    assert counters == dict.fromkeys(counters, 0)
    backend.close()


# --- bus errors -----------------------------------------------------------------------------------


def test_a_missing_reply_is_awaited_without_polling_and_not_requested_again(bus, connect):
    backend = connect(bus, reply_timeout=1.0)
    reading = Reading()
    backend.read(reading)
    kept = list(reading.q)
    bus.fault("silent=1")
    begin = time.thread_time()
    backend.read(reading)
    busy = time.thread_time() - begin
    assert not reading.valid
    assert reading.seq == 2
    assert reading.q == kept
    assert busy < 0.1, "read must sleep while it waits"
    assert backend.counters()["timeouts"] == 1, "read must not repeat the request"
    bus.fault("answer=1")
    backend.read(reading)
    assert reading.valid


@pytest.mark.parametrize("kind", ["corrupt", "duplicate", "truncate", "drop"])
@FIRMWARES
def test_corrupted_replies_never_give_wrong_readings(running, kind, firmware, connect):
    bus = running(placed(firmware, 2148, 1998))
    backend = connect(bus, reply_timeout=0.05)
    bus.fault(f"{kind}=0.4")
    reading, good = Reading(), 0

    def some() -> bool:
        nonlocal good
        before = backend.counters()["retries"]
        backend.read(reading)
        assert backend.counters()["retries"] - before <= 1
        if reading.valid:
            good += 1
            assert reading.q == pytest.approx([100 * RADIAN, 50 * RADIAN])
        return good > 3 and reading.seq >= 30

    until(some)
    assert kind != "corrupt" or backend.counters()["crc"] > 0
    bus.fault(f"{kind}=0")
    until(lambda: (backend.read(reading), reading.valid)[1])


@FIRMWARES
@pytest.mark.parametrize("lateness", [1, 4, 9])
def test_a_late_reply_is_not_used_for_a_later_request(running, firmware, lateness, connect):
    """The reply to each request arrives together with a later request."""
    bus = running(placed(firmware, 0, 0))
    backend = connect(bus, reply_timeout=0.008, zero=(0, 0))
    reply, waiting = bus.bus.exchange, deque()

    def reply_late(*request: object) -> list[TimedReply]:
        waiting.append(reply(*request))
        return waiting.popleft() if len(waiting) > lateness else []

    def reply_to_all(*request: object) -> list[TimedReply]:
        earlier = [each for replies in waiting for each in replies]
        waiting.clear()
        return earlier + reply(*request)

    reading = Reading()

    def read_at_another_place() -> bool:
        """Move the joints and read them; a valid reading must not show an earlier angle."""
        count, served = reading.seq, bus.bus.packets
        bus.call(lambda: bus.bus.plant.q.__setitem__(slice(2), count * RADIAN))
        backend.read(reading)
        if reading.valid:
            assert reading.q == pytest.approx([count * RADIAN, -count * RADIAN])
        until(lambda: bus.bus.packets > served)  # Requests must not wait in the port.
        return reading.valid

    def has_ignored_late_replies() -> bool:
        assert not read_at_another_place()
        return backend.counters()["late"] >= 20

    bus.call(lambda: setattr(bus.bus, "exchange", reply_late))
    until(has_ignored_late_replies)
    bus.call(lambda: setattr(bus.bus, "exchange", reply_to_all))
    until(read_at_another_place)


def test_a_joint_outside_its_servo_limits_is_named_in_position_mode(running, connect):
    bus = running(servos={"mode": "position"})
    bus.call(lambda: bus.servo(0).table.set(reg.MAX_POSITION_LIMIT, 2700))
    bus.call(lambda: bus.bus.plant.q.__setitem__(0, 702 * RADIAN))
    backend = connect(bus, mode="position")
    with pytest.raises(ServoError, match="the position is 2750 counts, expected 0 to 2700"):
        backend.torque_on()


def test_the_hardware_error_belongs_to_the_present_alert(bus, connect):
    backend, reading = connect(bus), Reading()
    bus.fault("overload=1")
    backend.read(reading)
    assert reading.hardware == [1 << reg.OVERLOAD, 0]
    bus.fault("reboot=1")
    until(lambda: (backend.read(reading), reading.valid and not reading.alert)[1])
    assert reading.hardware == [0, 0]
    # The reply that explains the next alert is lost, so the daemon asks again.
    bus.fault("overheat=1")
    errors = backend._reads.errors
    errors.exchange, exchange = lambda: COMM_RX_TIMEOUT, errors.exchange
    until(lambda: (backend.read(reading), reading.alert)[1])
    assert (reading.alert, reading.hardware) == (1, [0, 0])
    errors.exchange = exchange
    backend.read(reading)
    assert reading.hardware == [1 << reg.OVERHEATING, 0]


def test_a_watchdog_trip_stops_the_servos_and_is_reported(bus, connect):
    backend = connect(bus, watchdog=0.5)
    backend.torque_on()
    goal = Goal(q=[0.9, 0.9], current=[0.05, 0.05])
    backend.write(goal)
    until(lambda: bus.memory(0)[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR)

    def look() -> None:
        for _ in range(2):  # The first reading includes the voltage check.
            backend.read(Reading())

    with pytest.raises(ServoError, match="the bus watchdog stopped the servo"):
        look()
    assert backend.torque_off(Reading())
    backend.torque_on()
    backend.write(Goal(q=[0.1, 0.1], current=[0.2, 0.2]))


@pytest.mark.parametrize(
    "what", ["the bus watchdog stopped the servo", "the bus watchdog is off, possibly because"]
)
def test_a_servo_that_stopped_by_itself_is_detected_despite_timely_writes(bus, connect, what):
    # If an adapter delays packets or power is lost briefly, a servo may stop by itself.
    backend = connect(bus)
    backend.torque_on()
    goal, reading = Goal(q=[0.1, 0.1], current=[0.05, 0.05]), Reading()
    backend.write(goal)
    servo = bus.servo(1)
    if "off" in what:
        bus.call(lambda: servo.reboot(bus.now()))
    else:
        bus.call(lambda: servo.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR))
    with pytest.raises(ServoError, match=f"right.*: {what}"):
        until(lambda: backend.read(reading) or backend.write(goal))
    assert backend.torque_off(Reading())
    backend.torque_on()


def test_torque_off_needs_confirmation_from_every_servo(bus, connect):
    backend = connect(bus, reply_timeout=0.25)
    backend.torque_on()
    bus.fault("silent=2")
    assert not backend.torque_off(Reading())
    until(lambda: not bus.servo(0).torque_on)
    bus.fault("answer=2")
    until(lambda: backend.torque_off(Reading()))  # On a busy machine, the servo may reply too late.
    assert not bus.servo(1).torque_on


@pytest.mark.parametrize("mode", ["current-based position", "current", "position"])
def test_lost_goals_are_detected(running, mode, connect):
    bus = running(servos={"mode": mode})
    backend = connect(bus, mode=mode)
    backend.torque_on()
    reading, goal = Reading(), Goal(current=[0.2, 0.2])
    sent = 0

    def tick() -> Reading:
        nonlocal sent
        sent += 1
        goal.q[:] = [0.5 * math.sin(0.05 * sent)] * 2
        goal.current[:] = [0.01 + 0.003 * (sent % 50)] * 2
        backend.read(reading)
        backend.write(goal)
        return reading

    checks: set[float] = set()

    def has_checked_repeatedly() -> bool:
        assert not tick().lost
        checks.add(backend._next_check)  # Each check sets the time of the next one.
        return len(checks) > 10

    until(has_checked_repeatedly)
    bus.fault("lose-writes=1")
    before = sent
    until(lambda: tick().lost == 0b11)
    assert sent - before >= 17, "a single lost goal must not be reported"
    bus.fault("lose-writes=0")
    until(lambda: tick().lost == 0)


def test_a_servo_that_repeats_the_same_bytes_is_detected(bus, connect):
    backend = connect(bus)
    reading = Reading()
    backend.read(reading)
    bus.fault("frozen=2")

    def frozen() -> bool:
        backend.read(reading)
        return reading.frozen == 0b10

    until(frozen)
    bus.fault("recover=2")
    until(lambda: not frozen())


@FIRMWARES
def test_a_reply_with_an_error_is_not_a_reading(running, firmware, connect):
    bus = running(placed(firmware))
    backend = connect(bus)
    reading = Reading()
    bus.fault("refuse=2")
    backend.read(reading)
    assert not reading.valid
    assert backend.counters()["refused"] > 0
    bus.fault("recover=2")
    backend.read(reading)
    assert reading.valid


def test_close_turns_torque_off_on_a_noisy_line(bus, connect):
    backend = connect(bus, reply_timeout=0.1)
    backend.torque_on()
    bus.fault("drop=0.3")
    backend.close()
    until(lambda: not bus.servo(0).torque_on and not bus.servo(1).torque_on)


def test_nothing_works_before_connect():
    backend = DynamixelServos(backend_settings("/dev/does-not-exist"), RealClock())
    backend.write(Goal())
    backend.close()
    with pytest.raises(ServoError, match="not connected"):
        backend.read(Reading())
    with pytest.raises(ServoError, match="not connected"):
        backend.torque_on()
