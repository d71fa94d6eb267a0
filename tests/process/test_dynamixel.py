"""The Dynamixel backend over the real SDK and pyserial against emulated servos on a pty."""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import numpy as np
import pytest
import serial
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import ServoSettings, Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos import port as port_module
from softfinger.daemon.servos.checks import Registers, check_latency, check_servo, notice_servo
from softfinger.daemon.servos.control_table import JointScale, by_name, name_of
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.port import PortGone, SerialPort
from softfinger.daemon.servos.protocol import FastGroupRead, GroupRead, PacketHandler
from softfinger.daemon.simulation.physics.free_joints import FreeJoints
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.types import Goal, Reading
from tests.conftest import until
from tests.harness.servos import RADIAN, RunningBus, hand_bus, make_bus

# The bus shares this process's interpreter lock, so replies need longer than on a wire.
PATIENCE = 1.0


def profile(path: str, **servos: Any) -> Settings:
    values = {"backend": "dynamixel", "port": path, "reply_timeout": PATIENCE} | servos
    return Settings.model_validate({"servos": values})


def present_bus(model: str = "XM430-W350", **options: Any) -> ServoBus:
    return hand_bus(time.monotonic(), {"model": model}, **options)


@pytest.fixture
def running() -> Iterator[Callable[..., RunningBus]]:
    """Starts buses that end with the test."""
    buses: list[RunningBus] = []

    def start(bus: ServoBus | None = None, **options: Any) -> RunningBus:
        buses.append(RunningBus(bus, **options))
        return buses[-1]

    yield start
    for bus in buses:
        bus.close()


@pytest.fixture
def bus(running: Callable[..., RunningBus]) -> RunningBus:
    return running()


def connected(bus: RunningBus, **servos: Any) -> DynamixelServos:
    backend = DynamixelServos(profile(bus.path, **servos), RealClock())
    backend.connect()
    return backend


def refusal(bus: RunningBus, settings: Settings | None = None, **servos: Any) -> str:
    backend = DynamixelServos(settings or profile(bus.path, **servos), RealClock())
    with pytest.raises(ServoError) as caught:
        backend.connect()
    backend.close()
    return str(caught.value)


def go(backend: DynamixelServos, goal: Goal, done: Callable[[Reading], bool]) -> Reading:
    reading = Reading()

    def there() -> bool:
        backend.read(reading)
        backend.write(goal)
        return done(reading)

    until(there)
    return reading


# --- connect -----------------------------------------------------------------------------------


def test_connect_changes_nothing_and_stiffens_nothing(bus: RunningBus) -> None:
    before = [bus.memory(i) for i in (0, 1)]
    backend = connected(bus)
    reading = Reading()
    for _ in range(5):
        backend.read(reading)
        backend.write(Goal(q=[0.5, 0.5], current=[1.0, 1.0]))
    backend.close()
    for i in (0, 1):
        after = bus.memory(i)
        live = slice(reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE + 1)
        assert after[: live.start] == before[i][: live.start]
        assert after[live.stop :] == before[i][live.stop :]
    assert not bus.servo(0).torque_on


def test_everything_wrong_is_told_at_once_with_what_mends_it(
    running: Callable[..., RunningBus],
) -> None:
    bus = running(present_bus(prepared=False))
    bus.fault("overload=2")
    text = refusal(bus)
    lines = text.splitlines()
    assert len(lines) == 5
    assert sum("operating mode is position (3)" in line for line in lines) == 2
    assert sum("return delay is 500 µs" in line for line in lines) == 2
    assert sum("hardware error: overload" in line for line in lines) == 1
    assert all("softfinger doctor --fix" in line for line in lines)
    assert "servo 1 (left)" in text
    assert "servo 2 (right)" in text


def test_a_drive_mode_that_stiffens_with_any_goal_is_refused(bus: RunningBus) -> None:
    memory = bus.servo(1).table.memory
    bus.call(lambda: memory.__setitem__(reg.DRIVE_MODE, 0b1000))
    text = refusal(bus)
    assert "servo 2 (right): drive mode 8 switches torque on with any goal" in text
    model, settings = by_name("XM430-W350"), profile(bus.path)
    assert check_servo("s", model, Registers(memory), settings, 1)
    bus.call(lambda: memory.__setitem__(reg.DRIVE_MODE, 0b0001))  # reversed: used, and told
    backend = connected(bus)
    backend.close()
    assert check_servo("s", model, Registers(memory), settings, 1) == []
    notices = notice_servo("s", model, Registers(memory), settings)
    assert any("drive mode is reversed" in each.problem for each in notices)


def test_one_missing_servo_is_named(bus: RunningBus) -> None:
    bus.fault("silent=2")
    text = refusal(bus, reply_timeout=0.02)
    assert text.count("\n") == 0
    assert "servo 2 (right): no answer at 2000000 baud" in text


def test_a_port_that_answers_nothing(bus: RunningBus) -> None:
    bus.fault("silent=1")
    bus.fault("silent=2")
    text = refusal(bus, reply_timeout=0.02)
    assert "no servo answers at 2000000 baud (IDs 1, 2)" in text
    assert "power" in text


def test_the_wrong_rate_is_met_with_silence(running: Callable[..., RunningBus]) -> None:
    bus = running(baud=1_000_000)
    assert "no servo answers at 3000000 baud" in refusal(bus, baud=3_000_000, reply_timeout=0.02)
    backend = connected(bus, baud=1_000_000)
    backend.close()


def test_a_missing_port(bus: RunningBus) -> None:
    assert "no such port" in refusal(bus, profile("/dev/does-not-exist"))


def test_a_line_without_a_watchdog_is_told(bus: RunningBus) -> None:
    backend = connected(bus, watchdog=0.0, fault_after=60.0)
    assert (
        sum("servos.watchdog = 0: nothing stops it" in str(each) for each in backend.notices) == 2
    )
    assert (
        sum("servos.fault_after = 60 s: without an answer" in n for n in map(str, backend.notices))
        == 2
    )
    backend.close()


def test_a_second_daemon_gets_a_clear_error_and_disturbs_nothing(bus: RunningBus) -> None:
    first = connected(bus)
    assert "in use by another process" in refusal(bus)
    reading = Reading()
    first.read(reading)
    assert reading.valid
    first.close()
    connected(bus).close()  # free again


def test_another_model_than_configured(running: Callable[..., RunningBus]) -> None:
    bus = running(present_bus(model="XM430-W210"))
    assert refusal(bus).count("is an XM430-W210, not an XM430-W350: set servos.model") == 2


def test_a_model_without_current_control(running: Callable[..., RunningBus]) -> None:
    bus = running(present_bus(model="XL430-W250"))
    assert refusal(bus, model="XL430-W250").count("no current-based position mode") == 2


def test_an_undervoltage_and_a_low_current_limit(bus: RunningBus) -> None:
    bus.fault("undervoltage=1")
    bus.call(lambda: bus.servo(1).table.set(reg.CURRENT_LIMIT, 100))
    text = refusal(bus)
    assert "servo 1 (left): supply is 8.5 V, not in 9.5 … 16.0 V" in text
    assert "servo 2 (right): current limit is 0.269 A, below safety.current_max" in text


def test_torque_that_was_on_is_told_and_left_alone(bus: RunningBus) -> None:
    bus.call(lambda: bus.servo(0).write(reg.TORQUE_ENABLE, b"\x01", time.monotonic()))
    backend = connected(bus)
    assert [n for n in map(str, backend.notices) if "servo 1 (left): torque is on" in n]
    goal = bus.memory(0)[reg.GOAL_CURRENT : reg.GOAL_POSITION + 4]
    backend.write(Goal(q=[0.5, 0.5], current=[1.0, 1.0]))
    backend.close()
    assert bus.memory(0)[reg.GOAL_CURRENT : reg.GOAL_POSITION + 4] == goal
    assert bus.servo(0).torque_on


def test_a_scene_with_one_finger_asks_for_one_servo(running: Callable[..., RunningBus]) -> None:
    bus = running()
    bus.fault("silent=1")
    settings = profile(bus.path).model_copy(
        update={"scene": Settings.model_validate({"scene": {"fingers": ("right",)}}).scene}
    )
    backend = DynamixelServos(settings, RealClock())
    backend.connect()
    backend.torque_on()
    reading = go(
        backend,
        Goal(q=[9.0, 0.2], current=[0.5, 0.5]),
        lambda r: abs(r.q[1] - 0.2) < 0.01,
    )
    backend.close()
    assert reading.q[0] == 0.0


def test_latency_timer_of_an_adapter() -> None:
    assert "is 16 ms" in str(check_latency("/dev/ttyUSB0", 0.016))
    assert check_latency("/dev/ttyUSB0", 0.001) is check_latency("x", 0.0) is None


def test_an_adapters_latency_timer_is_asked_to_be_low(
    bus: RunningBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = Path(os.path.realpath(bus.path)).name
    (tmp_path / name / "device").mkdir(parents=True)
    place = tmp_path / name / "device" / "latency_timer"
    place.write_text("16\n")
    monkeypatch.setattr(port_module, "_SYSFS", tmp_path)
    # The mode is not there, as on this pseudo-terminal: it is told, and what mends it.
    text = refusal(bus, reply_timeout=0.004)
    assert "the adapter's latency timer is 16 ms" in text
    assert "`softfinger doctor --fix` sets it to 1 ms" in text
    # The mode is there: a driver then sets the timer to 1 ms by itself.
    asked = []

    def low(_: serial.Serial, on: bool) -> None:
        asked.append(on)
        place.write_text("1\n")

    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", low)
    backend = connected(bus)
    assert asked == [True]
    assert not [notice for notice in map(str, backend.notices) if "latency" in notice]
    backend.close()
    place.write_text("nonsense")
    port = SerialPort(bus.path, 2_000_000, PATIENCE, low_latency=False)
    port.openPort()
    assert port.latency_timer() == 0.0
    assert asked == [True]
    port.closePort()


# --- reading and writing -----------------------------------------------------------------------


@pytest.mark.parametrize("firmware", [44, 48], ids=["sync read", "fast sync read"])
def test_what_is_read_is_what_the_servos_have(
    running: Callable[..., RunningBus], firmware: int
) -> None:
    plain = make_bus(
        "XM430-W350", firmware=firmware, prepared=True, counts=(2048, 2048), t=time.monotonic()
    )
    now = time.monotonic()
    bus = running(plain)
    backend = connected(bus, zero=(2048, 2048))

    def place() -> None:
        plain.plant.q[:] = (2048 + 100) * RADIAN, (2048 - 50) * RADIAN
        plain.plant.current[:] = 100 * 2.69e-3, -7 * 2.69e-3
        plain.faults.rates.drop = 0.0

    bus.call(place)
    reading = Reading()
    backend.read(reading)
    assert reading.valid
    assert reading.seq == 1
    assert reading.t >= now
    assert reading.alert == 0
    # Direction is +1 for the left and −1 for the right joint.
    assert reading.q == pytest.approx([100 * RADIAN, 50 * RADIAN])
    assert [bool(n) for n in map(str, backend.notices)] == [True] * (2 if firmware == 44 else 0)
    backend.close()


def test_goals_arrive_as_counts_and_bounds_are_kept(bus: RunningBus) -> None:
    backend = connected(bus)
    backend.torque_on()
    backend.write(Goal(q=[0.25, -0.1], current=[0.8, 99.0]))
    reading = Reading()
    backend.read(reading)  # the write has no answer; this one comes after it
    left, right = (bus.memory(i)[reg.GOAL_CURRENT :] for i in (0, 1))
    assert struct.unpack_from("<h", left)[0] == int(0.8 / 2.69e-3)
    assert struct.unpack_from("<h", right)[0] == 1193  # the current limit
    assert struct.unpack_from("<i", left, 14)[0] == 2048 + round(0.25 / RADIAN)
    assert struct.unpack_from("<i", right, 14)[0] == 2048 + round(0.1 / RADIAN)
    backend.close()
    assert not bus.servo(0).torque_on
    assert not bus.servo(1).torque_on


def test_torque_on_starts_where_the_joint_is(bus: RunningBus) -> None:
    def place() -> None:
        bus.bus.plant.q[:] = (0.4, -0.3)
        for servo in bus.bus.servos:
            servo.table.set(reg.GOAL_POSITION, 0)
            servo.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR)

    bus.call(place)
    backend = connected(bus)
    assert sum("bus watchdog had stopped it" in notice for notice in map(str, backend.notices)) == 2
    backend.torque_on()
    for i, direction in ((0, 1), (1, -1)):
        memory = bus.memory(i)
        goal = struct.unpack_from("<i", memory, reg.GOAL_POSITION)[0]
        expected = 2048 + direction * round((0.4, -0.3)[i] / RADIAN)
        assert goal == expected
        assert struct.unpack_from("<h", memory, reg.GOAL_CURRENT)[0] == 0
        assert memory[reg.TORQUE_ENABLE] == 1
        assert memory[reg.BUS_WATCHDOG] == 5  # 0.1 s
    reading = Reading()
    backend.read(reading)
    assert reading.q == pytest.approx([0.4, -0.3], abs=RADIAN)
    assert backend.torque_off(Reading())
    assert all(bus.memory(i)[reg.TORQUE_ENABLE] == 0 for i in (0, 1))
    assert all(bus.memory(i)[reg.BUS_WATCHDOG] == 0 for i in (0, 1))
    backend.close()


def test_torque_is_refused_where_the_joint_can_not_be(bus: RunningBus) -> None:
    def turn() -> None:
        bus.bus.plant.q[1] = 4.0

    bus.call(turn)
    backend = connected(bus)
    assert [n for n in map(str, backend.notices) if "servo 2 (right): the joint is at 229°" in n]
    with pytest.raises(ServoError, match=r"servo 2 \(right\): the joint is at 229°, not in -29°"):
        backend.torque_on()
    assert not bus.servo(0).torque_on
    assert not bus.servo(1).torque_on
    backend.close()


@pytest.mark.parametrize(
    ("model", "level"), [("XM430-W350", 2), ("XL330-M288", 1), ("XC330-T288", 2)]
)
def test_the_joints_go_where_they_are_told(
    running: Callable[..., RunningBus], model: str, level: int
) -> None:
    bus = running(present_bus(model=model))
    bus.call(lambda: [s.table.set(reg.STATUS_RETURN_LEVEL, level) for s in bus.bus.servos])
    limit = by_name(model).stall_current
    settings = profile(bus.path, model=model).model_copy(
        update={
            "safety": Settings.model_validate(
                {"safety": {"current_max": limit, "current_move": 0.1}}
            ).safety
        }
    )
    backend = DynamixelServos(settings, RealClock())
    backend.connect()
    backend.torque_on()
    goal = Goal(q=[0.3, -0.2], current=[0.5, 0.5])
    reading = go(backend, goal, lambda r: r.q == pytest.approx(goal.q, abs=0.01))
    assert reading.valid
    assert backend.counters() == dict.fromkeys(backend.counters(), 0)
    backend.close()


def test_an_alert_is_told_and_arming_is_refused(bus: RunningBus) -> None:
    backend = connected(bus)
    bus.fault("overload=2")
    reading = Reading()
    backend.read(reading)
    assert reading.valid
    assert reading.alert == 2
    with pytest.raises(ServoError, match=r"servo 2 \(right\): hardware error: overload"):
        backend.torque_on()
    assert not bus.servo(0).torque_on
    backend.close()


# --- when the bus goes wrong -------------------------------------------------------------------


def test_a_missing_reply_costs_the_deadline_and_no_more(bus: RunningBus) -> None:
    backend = connected(bus, reply_timeout=0.5)
    reading = Reading()
    backend.read(reading)
    kept = list(reading.q)
    bus.fault("silent=1")
    begin, cpu = time.monotonic(), time.thread_time()
    backend.read(reading)
    spent, busy = time.monotonic() - begin, time.thread_time() - cpu
    assert not reading.valid
    assert reading.seq == 2
    assert reading.q == kept
    assert spent >= 0.5
    assert busy < 0.1 * spent, "it must sleep"
    assert backend.counters()["timeouts"] == 1, "it must not ask again"
    bus.fault("answer=1")
    backend.read(reading)
    assert reading.valid
    backend.close()


def test_a_damaged_reply_is_asked_for_again(bus: RunningBus) -> None:
    backend = connected(bus)
    bus.fault("corrupt=0.5")
    reading = Reading()
    good = 0
    for _ in range(60):
        before = backend.counters()["retries"]
        backend.read(reading)
        good += reading.valid
        if reading.valid:
            assert reading.q == [0.0, 0.0]  # never a wrong number
        assert backend.counters()["retries"] - before <= 1
        if backend.counters()["timeouts"] + backend.counters()["torn"] > 3:
            break
    assert good > 3
    assert backend.counters()["crc"] > 0
    bus.fault("corrupt=0")
    backend.close()


@pytest.mark.parametrize("kind", ["duplicate", "truncate", "drop"])
@pytest.mark.parametrize("firmware", [44, 48])
def test_unruly_replies_give_right_numbers_or_none(
    running: Callable[..., RunningBus], kind: str, firmware: int
) -> None:
    plain = make_bus(
        "XM430-W350", firmware=firmware, prepared=True, counts=(2148, 1998), t=time.monotonic()
    )
    bus = running(plain)
    backend = connected(bus, reply_timeout=0.05)
    bus.fault(f"{kind}=0.4")
    reading, good = Reading(), 0

    def some() -> bool:
        nonlocal good
        backend.read(reading)
        if reading.valid:
            good += 1
            assert reading.q == pytest.approx([100 * RADIAN, 50 * RADIAN])
        return good > 3 and reading.seq >= 30

    until(some)
    bus.fault(f"{kind}=0")
    until(lambda: (backend.read(reading), reading.valid)[1])
    backend.read(reading)
    assert reading.valid
    backend.close()


@pytest.mark.parametrize("firmware", [44, 48])
def test_a_late_reply_is_not_taken_for_the_next_questions(
    running: Callable[..., RunningBus], firmware: int
) -> None:
    bus = running(
        make_bus("XM430-W350", firmware=firmware, prepared=True, counts=(0, 0), t=time.monotonic())
    )
    backend = connected(bus, reply_timeout=0.004, zero=(0, 0))  # a late one comes after 0.01
    reading = Reading()

    def at_another_place(count: int) -> None:
        """Read the joints at ``count``: an answer to an earlier question would tell another."""
        bus.call(lambda: bus.bus.plant.q.__setitem__(slice(2), count * RADIAN))
        backend.read(reading)
        if reading.valid:  # where this thread was put aside until the late one came
            assert reading.q == pytest.approx([count * RADIAN, -count * RADIAN])

    bus.fault("late=1")
    until(lambda: at_another_place(reading.seq) or backend.counters()["late"] > 20)
    bus.fault("late=0")
    until(lambda: at_another_place(reading.seq) or reading.valid)
    backend.close()


def test_the_servos_own_watchdog_stops_them_and_that_is_told(bus: RunningBus) -> None:
    backend = connected(bus, watchdog=0.04)
    backend.torque_on()
    goal = Goal(q=[0.9, 0.9], current=[0.05, 0.05])
    backend.write(goal)
    until(lambda: bus.memory(0)[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR)

    def look() -> None:
        for _ in range(2):  # the first one looks at the supply
            backend.read(Reading())

    with pytest.raises(ServoError, match="its bus watchdog stopped it"):
        look()
    assert backend.torque_off(Reading())
    backend.torque_on()
    backend.write(Goal(q=[0.1, 0.1], current=[0.2, 0.2]))
    assert backend.counters()["timeouts"] == 0
    backend.close()


def test_a_stop_by_the_watchdog_is_found_though_all_was_sent_in_time(bus: RunningBus) -> None:
    # As where an adapter held packets up that the port had taken.
    backend = connected(bus, watchdog=2.0)
    backend.torque_on()
    goal, reading = Goal(q=[0.1, 0.1], current=[0.05, 0.05]), Reading()
    backend.write(goal)
    servo = bus.servo(1)
    bus.call(lambda: servo.table.set(reg.BUS_WATCHDOG, reg.WATCHDOG_ERROR))
    with pytest.raises(ServoError, match=r"right.*: its bus watchdog stopped it"):
        until(lambda: backend.read(reading) or backend.write(goal))
    backend.close()


def test_a_servo_that_lost_its_power_for_a_moment_is_found(bus: RunningBus) -> None:
    backend = connected(bus, watchdog=2.0)
    backend.torque_on()
    goal, reading = Goal(q=[0.1, 0.1], current=[0.05, 0.05]), Reading()
    backend.write(goal)
    servo = bus.servo(1)
    bus.call(lambda: servo.reboot(time.monotonic()))
    with pytest.raises(ServoError, match=r"right.*: its bus watchdog is off, as after a reboot"):
        until(lambda: backend.read(reading) or backend.write(goal))
    assert backend.torque_off(Reading())
    backend.torque_on()
    backend.close()


def test_a_port_that_goes_away(bus: RunningBus) -> None:
    backend = connected(bus)
    backend.torque_on()
    bus.call(bus.port.unplug)
    with pytest.raises(PortGone, match="the port is gone"):
        backend.read(Reading())
    with pytest.raises(ServoError):
        backend.torque_off(Reading())
    backend.close()
    backend.close()


def test_torque_off_counts_once_every_servo_says_so(bus: RunningBus) -> None:
    backend = connected(bus, reply_timeout=0.01)
    backend.torque_on()
    bus.fault("silent=2")
    assert not backend.torque_off(Reading())
    assert not bus.servo(0).torque_on
    bus.fault("answer=2")
    assert backend.torque_off(Reading())
    assert not bus.servo(1).torque_on
    backend.close()


def test_writes_that_get_lost_are_never_taken_for_done(bus: RunningBus) -> None:
    backend = connected(bus, watchdog=0.0)
    backend.torque_on()
    bus.fault("lose-writes=1")
    reading = Reading()
    for _ in range(5):
        assert not backend.torque_off(reading)
        assert reading.valid
    assert bus.servo(0).torque_on
    bus.fault("lose-writes=0")
    assert backend.torque_off(reading)
    backend.close()


@pytest.mark.parametrize("mode", ["current-based position", "current", "position"])
def test_goals_that_do_not_arrive_are_noticed(
    running: Callable[..., RunningBus], mode: str
) -> None:
    now = time.monotonic()
    settings = Settings.model_validate({"servos": {"mode": mode}})
    bus = running(ServoBus.from_settings(settings, FreeJoints(2, now), t=now))
    backend = connected(bus, mode=mode, watchdog=2.0)
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

    begin = time.monotonic()
    while time.monotonic() < begin + 0.2:
        assert not tick().lost
    bus.fault("lose-writes=1")
    before = sent
    until(lambda: tick().lost == 0b11)
    assert sent - before >= 17, "a single goal that was lost is no cause"
    bus.fault("lose-writes=0")
    until(lambda: tick().lost == 0)
    backend.close()


def test_a_servo_that_answers_with_the_same_bytes_again_and_again_is_noticed(
    bus: RunningBus,
) -> None:
    backend = connected(bus)
    reading = Reading()
    backend.read(reading)
    bus.fault("frozen=2")

    def frozen() -> bool:
        backend.read(reading)
        return reading.frozen == 0b10

    until(frozen)
    bus.fault("recover=2")
    until(lambda: not frozen())
    backend.close()


@pytest.mark.parametrize("firmware", [44, 48], ids=["sync read", "fast sync read"])
def test_an_answer_with_an_error_is_no_reading(
    running: Callable[..., RunningBus], firmware: int
) -> None:
    plain = make_bus("XM430-W350", firmware=firmware, prepared=True, t=time.monotonic())
    bus = running(plain)
    backend = connected(bus)
    reading = Reading()
    bus.fault("refuse=2")
    backend.read(reading)
    assert not reading.valid
    assert backend.counters()["refused"] > 0
    bus.fault("recover=2")
    backend.read(reading)
    assert reading.valid
    backend.close()


def test_close_turns_torque_off_on_a_bad_line(bus: RunningBus) -> None:
    backend = connected(bus, reply_timeout=0.01)
    backend.torque_on()
    bus.fault("drop=0.3")
    backend.close()
    assert not bus.servo(0).torque_on
    assert not bus.servo(1).torque_on


def test_nothing_works_before_connect() -> None:
    backend = DynamixelServos(profile("/dev/does-not-exist"), RealClock())
    backend.write(Goal())
    backend.close()
    with pytest.raises(ServoError, match="not connected"):
        backend.read(Reading())
    with pytest.raises(ServoError, match="not connected"):
        backend.torque_on()


# --- the SDK's traps ---------------------------------------------------------------------------


@pytest.fixture
def line(bus: RunningBus) -> Iterator[tuple[SerialPort, PacketHandler]]:
    port = SerialPort(bus.path, 2_000_000, PATIENCE)
    port.openPort()
    yield port, PacketHandler()
    port.closePort()


def test_goal_current_minus_one_and_goal_velocity_minus_three(
    bus: RunningBus, line: tuple[SerialPort, PacketHandler]
) -> None:
    port, handler = line
    goals = list(struct.pack("<hi", -1, -3))
    plain = sdk.PacketHandler(2.0)
    before = bus.memory(0)[reg.GOAL_CURRENT : reg.GOAL_CURRENT + 6]
    port.setPacketTimeoutMillis(20)
    plain.writeTxOnly(port, 1, reg.GOAL_CURRENT, 6, goals)
    assert bus.memory(0)[reg.GOAL_CURRENT : reg.GOAL_CURRENT + 6] == before
    assert handler.writeTxRx(port, 1, reg.GOAL_CURRENT, 6, goals) == (sdk.COMM_SUCCESS, 0)
    assert bus.servo(0).table.get(reg.GOAL_CURRENT) == -1
    assert bus.servo(0).table.get(reg.GOAL_VELOCITY) == -3
    data, result, error = handler.readTxRx(port, 1, reg.GOAL_CURRENT, 6)
    assert (bytes(data), result, error) == (bytes(goals), sdk.COMM_SUCCESS, 0)


@hypothesis_settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.lists(st.sampled_from([0xFF, 0xFD, 0x12, 0x00]), min_size=1, max_size=28).map(bytes),
    fast=st.booleans(),
)
def test_any_bytes_come_and_go_unchanged(
    bus: RunningBus, line: tuple[SerialPort, PacketHandler], data: bytes, fast: bool
) -> None:
    port, handler = line
    start = 224  # indirect data pointing at itself: plain memory
    result, error = handler.writeTxRx(port, 1, start, len(data), list(data))
    assert (result, error) == (sdk.COMM_SUCCESS, 0)
    assert bus.memory(0)[start : start + len(data)] == data
    back, result, _ = handler.readTxRx(port, 1, start, len(data))
    assert (bytes(back), result) == (data, sdk.COMM_SUCCESS)
    group = (FastGroupRead if fast else GroupRead)(port, handler, start, len(data), [1])
    assert group.exchange() == sdk.COMM_SUCCESS
    assert group.data[1] == data


def test_every_register_reads_as_the_table_has_it(
    bus: RunningBus, line: tuple[SerialPort, PacketHandler]
) -> None:
    port, handler = line
    size = bus.servo(1).table.size
    for address in range(0, size, 61):
        length = min(61, size - address)
        data, result, _ = handler.readTxRx(port, 2, address, length)
        assert result == sdk.COMM_SUCCESS
        memory = bus.memory(1)[address : address + length]
        live = range(reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE + 1)
        assert all(a == b for i, (a, b) in enumerate(zip(data, memory, strict=True), address)
                   if i not in live)  # fmt: skip
    assert handler.readTxRx(port, 2, size - 1, 2)[2] == 7


def test_other_calls_of_the_sdk_work_through_our_handler(
    bus: RunningBus, line: tuple[SerialPort, PacketHandler]
) -> None:
    port, handler = line
    assert handler.ping(port, 1) == (1020, sdk.COMM_SUCCESS, 0)
    assert handler.write4ByteTxRx(port, 1, reg.PROFILE_VELOCITY, 77) == (sdk.COMM_SUCCESS, 0)
    assert handler.read4ByteTxRx(port, 1, reg.PROFILE_VELOCITY) == (77, sdk.COMM_SUCCESS, 0)
    assert handler.regWriteTxRx(port, 2, reg.LED, 1, [1]) == (sdk.COMM_SUCCESS, 0)
    assert handler.action(port, 2) == sdk.COMM_SUCCESS
    # The SDK does not wait for that reply, which must not be taken for the next one's.
    assert handler.read1ByteTxRx(port, 2, reg.LED) == (1, sdk.COMM_SUCCESS, 0)
    bulk = sdk.GroupBulkRead(port, handler)
    bulk.addParam(1, reg.PRESENT_POSITION, 4)
    bulk.addParam(2, reg.PRESENT_TEMPERATURE, 1)
    assert bulk.txRxPacket() == sdk.COMM_SUCCESS
    assert bulk.getData(1, reg.PRESENT_POSITION, 4) == 2048
    assert bulk.getData(2, reg.PRESENT_TEMPERATURE, 1) == 25
    assert bulk.fastBulkRead() == sdk.COMM_SUCCESS
    assert bulk.getData(1, reg.PRESENT_POSITION, 4) == 2048
    assert handler.reboot(port, 1) == (sdk.COMM_SUCCESS, 0)


def test_the_plain_sdk_is_served_too(bus: RunningBus) -> None:
    port = sdk.PortHandler(bus.path)
    handler = sdk.PacketHandler(2.0)
    assert port.openPort()
    assert port.setBaudRate(1_000_000)  # closes and opens the pty again
    assert handler.ping(port, 2) == (1020, sdk.COMM_SUCCESS, 0)
    read = sdk.GroupSyncRead(port, handler, reg.PRESENT_POSITION, 4)
    assert read.addParam(1)
    assert read.addParam(2)
    assert read.txRxPacket() == sdk.COMM_SUCCESS
    assert read.getData(2, reg.PRESENT_POSITION, 4) == 2048
    assert read.fastSyncRead() == sdk.COMM_SUCCESS
    assert read.getData(1, reg.PRESENT_POSITION, 4) == 2048
    found, result = handler.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS
    assert found == {1: [1020, 48], 2: [1020, 48]}
    port.closePort()


def test_error_bytes_of_a_group_read_are_kept(
    bus: RunningBus, line: tuple[SerialPort, PacketHandler]
) -> None:
    port, handler = line
    bus.fault("overload=1")
    for kind in (GroupRead, FastGroupRead):
        group = kind(port, handler, reg.PRESENT_POSITION, 4, [1, 2])
        assert group.exchange() == sdk.COMM_SUCCESS
        assert group.errors == {1: 0x80, 2: 0}
    beyond = GroupRead(port, handler, 660, 4, [1, 2])
    assert beyond.exchange() != sdk.COMM_SUCCESS


def test_noise_before_a_reply_is_skipped_and_counted() -> None:
    class Script(SerialPort):
        def __init__(self, data: bytes) -> None:
            super().__init__("script", 2_000_000, 0.01)
            self.received += data

        def fill(self) -> bool:
            return False

    status = bytes.fromhex("FFFFFD00010800 55 00 A6000000 8CC0")
    echo = bytes.fromhex("FFFFFD00010700 02 84000400 1D15")
    for noise in (b"\x00\xff", b"\xff\xff\xfd", echo, b"\xff\xff\xfd\x00\x01\xff\xff\x55"):
        handler = PacketHandler()
        packet, result = handler.rxPacket(Script(noise + status), False)
        assert (packet, result) == (status, sdk.COMM_SUCCESS)
        assert handler.skipped_bytes == len(noise)
    handler = PacketHandler()
    assert handler.rxPacket(Script(status[:-3]), False)[1] == sdk.COMM_RX_CORRUPT
    assert handler.torn == 1
    assert handler.rxPacket(Script(b""), False)[1] == sdk.COMM_RX_TIMEOUT
    assert handler.timeouts == 1


# --- tables and units --------------------------------------------------------------------------


def test_models_by_name_and_number() -> None:
    assert by_name("xl330-m288-t") is by_name("XL330-M288")
    assert name_of(1060) == "XL430-W250"
    assert name_of(1) == "model number 1"
    assert by_name("XL330-M288").highest_address(52) == 227
    assert by_name("XM430-W350").highest_address(48) == 661
    assert by_name("XL330-M288").baud_rates[-1] == 4_000_000


@given(
    direction=st.sampled_from([-1, 1]),
    zero=st.integers(-5000, 5000),
    ratio=st.floats(0.1, 50.0),
    counts=st.integers(-100_000, 100_000),
)
def test_units_there_and_back(direction: int, zero: int, ratio: float, counts: int) -> None:
    servos = ServoSettings(direction=(direction, direction), zero=(zero, zero), gear_ratio=ratio)
    scale = JointScale.of(servos, 1)
    assert scale.position_counts(scale.angle(counts)) == counts
    assert scale.velocity_counts(scale.rate(counts)) == counts
    assert scale.current_counts(scale.amperes(counts)) == counts
    assert scale.angle(zero) == 0.0
    turn = scale.angle(zero + direction * 4096)
    assert turn == pytest.approx(2.0 * np.pi / ratio)
    assert scale.bound_counts(-5 * 2.69e-3) == 5
