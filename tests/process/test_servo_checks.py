"""Test the servo checks on connection, the suggested fixes, and the servo health readings."""

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from softfinger.daemon.clock import RealClock, VirtualClock
from softfinger.daemon.diagnosis.devices import check_servos
from softfinger.daemon.diagnosis.register_file import restore_registers, save_registers
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.load import find, load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import checks, dynamixel
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.servos.checks import latency_file
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.protocol import SerialPort
from softfinger.daemon.servos.provisioning import provision, search
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat
from softfinger.daemon.types import Goal, Reading
from tests.conftest import until
from tests.harness.servos import RunningBus, backend_settings, connected, lasting_notices
from tests.process.conftest import Connect


def refusal(path: str, **servos: Any) -> list[str]:
    """Return the lines of the error that connecting raises."""
    backend = DynamixelServos(backend_settings(path, **servos), RealClock())
    with pytest.raises(ServoError) as caught:
        backend.connect()
    backend.close()
    return str(caught.value).splitlines()


def test_connecting_changes_nothing_and_leaves_torque_off(bus):
    live = slice(reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE + 1)

    def settled() -> list[bytes]:
        tables = [bus.memory(i) for i in (0, 1)]
        return [table[: live.start] + table[live.stop :] for table in tables]

    before = settled()
    backend = connected(bus)
    reading = Reading()
    for _ in range(5):
        backend.read(reading)
        backend.write(Goal(q=[0.5, 0.5], current=[1.0, 1.0]))
    backend.close()
    assert settled() == before
    assert not bus.servo(0).torque_on


LEFT, RIGHT = "servo 1 (left): ", "servo 2 (right): "
FIX = ": `softfinger doctor --fix`"
REBOOT = ": remove the cause, then reboot the servo with `softfinger doctor --fix`"


@pytest.mark.parametrize(
    ("options", "faults", "registers", "told"),
    [
        (
            {"factory": True},
            ["overload=2"],
            {},
            [
                f"{LEFT}return delay is 500 µs, expected at most 50 µs{FIX}",
                f"{LEFT}operating mode is position (3), expected current-based position (5){FIX}",
                f"{RIGHT}return delay is 500 µs, expected at most 50 µs{FIX}",
                f"{RIGHT}operating mode is position (3), expected current-based position (5){FIX}",
                f"{RIGHT}hardware error: overload{REBOOT}",
            ],
        ),
        (
            {},
            ["undervoltage=1"],
            {reg.CURRENT_LIMIT: 100},
            [
                f"{LEFT}supply voltage is 8.5 V, expected 9.5 to 16.0 V: check the power supply",
                f"{RIGHT}current limit is 0.269 A, expected at least "
                f"safety.current_max = 1.2 A{FIX}",
            ],
        ),
        (
            {},
            [],
            {reg.DRIVE_MODE: 0b1000},
            [
                f"{RIGHT}drive mode 8 switches torque on with any goal, or makes the servo follow "
                f"another servo{FIX}"
            ],
        ),
        (
            {"servos": {"model": "XM430-W210"}},
            [],
            {},
            [
                f"{LEFT}is an XM430-W210, expected an XM430-W350: set servos.model",
                f"{RIGHT}is an XM430-W210, expected an XM430-W350: set servos.model",
            ],
        ),
    ],
    ids=["factory-new and overloaded", "supply and limit", "drive mode", "model"],
)
def test_all_problems_are_listed_with_their_fixes(running, options, faults, registers, told):
    bus = running(**options)
    for fault in faults:
        bus.fault(fault)
    for address, value in registers.items():
        bus.call(lambda at=address, value=value: bus.servo(1).table.set(at, value))
    lines = refusal(bus.port)
    # The servo may already have reported the supply voltage.
    assert [line for line in lines if "input voltage" not in line] == told


def test_a_model_without_current_control_is_refused(running):
    bus = running(servos={"model": "XL430-W250", "mode": "position"})
    lines = refusal(bus.port, model="XL430-W250")
    assert sum("does not support current-based position mode" in line for line in lines) == 2


@pytest.mark.parametrize("silent", [(2,), (1, 2)])
def test_missing_servos_are_reported(bus, silent):
    for servo in silent:
        bus.fault(f"silent={servo}")
    (line,) = refusal(bus.port, reply_timeout=0.5)
    missing = "servo 2 (right): no reply at 2000000 baud: check the cable and the ID"
    nothing = f"{bus.port}: no servo replies at 2000000 baud (IDs 1, 2): check the power"
    assert line.startswith(missing if silent == (2,) else nothing)


def test_the_wrong_baud_rate_is_reported(running):
    bus = running(baud=1_000_000)
    (line,) = refusal(bus.port, baud=3_000_000, reply_timeout=0.05)
    assert "no servo replies at 3000000 baud" in line
    connected(bus, baud=1_000_000).close()


def test_unusable_ports_are_reported(bus):
    assert "port not found: connect the adapter" in refusal("/dev/does-not-exist")[0]
    assert "port not found: start `softfinger emulate`" in refusal("/tmp/does-not-exist/servos")[0]
    first = connected(bus)
    assert "in use by another program" in refusal(bus.port)[0]
    reading = Reading()
    first.read(reading)
    assert reading.valid
    first.close()
    connected(bus).close()  # The port is available again.


def test_a_port_lost_while_it_is_opened_is_reported(bus, monkeypatch):
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda *_: bus.fault("unplug"))
    (line,) = refusal(bus.port)
    assert line.startswith(f"{bus.port}: the port is lost (")


def test_minor_findings_are_notices(bus):
    servo = bus.servo(0)
    bus.call(lambda: servo.table.set(reg.DRIVE_MODE, 0b0001))
    bus.call(lambda: servo.write(reg.TORQUE_ENABLE, b"\x01", time.monotonic()))
    backend = connected(bus, watchdog=0.0, fault_after=60.0)
    notices = [str(each) for each in backend.notices]
    for finger in (LEFT, RIGHT):
        assert (
            f"{finger}servos.watchdog = 0: the servo keeps moving if the daemon or the bus fails"
            in notices
        )
        assert [
            n for n in notices if n.startswith(f"{finger}servos.fault_after = 60 s: if replies")
        ]
    assert [n for n in notices if n.startswith(f"{LEFT}the drive mode is reversed")]
    assert [n for n in notices if n.startswith(f"{LEFT}torque is already on")]
    span = slice(reg.GOAL_CURRENT, reg.GOAL_POSITION + 4)
    goal = bus.memory(0)[span]
    backend.write(Goal(q=[0.5, 0.5], current=[1.0, 1.0]))
    backend.close()
    assert bus.memory(0)[span] == goal  # Connecting does not change a servo with torque on.
    assert servo.torque_on


def test_forces_and_friction_that_overtax_a_model_are_notices(running):
    bus = running(servos={"model": "XL330-M288"})
    backend = connected(bus, model="XL330-M288")
    constant = "control.torque_constant is 1.78 N·m/A, but the servo's data sheet states 0.354"
    gears = "gear friction consumes 25% of the transmitted torque, so a grip may never settle"
    assert [each.text for each in lasting_notices(backend)] == 2 * [constant, gears]
    backend.close()
    for name in ("hil", "small"):  # profiles with sufficiently strong servos
        settings = load(find(Path(name)), Path("/tmp"))
        assert checks.notice_strength("", by_name(settings.servos.model), settings) == []


def test_an_adapter_is_set_to_low_latency(bus, tmp_path, monkeypatch):
    name = Path(os.path.realpath(bus.port)).name
    (tmp_path / name / "device").mkdir(parents=True)
    place = tmp_path / name / "device" / "latency_timer"
    place.write_text("16\n")
    monkeypatch.setattr(checks, "latency_file", lambda path: latency_file(path, tmp_path))
    # A pseudo-terminal has no low-latency mode.
    text = "16 ms, expected 1 ms: every read waits for this timer"
    fix = f"softfinger doctor --fix, or: echo 1 | sudo tee {place}"
    assert refusal(bus.port, reply_timeout=0.004)[0] == f"{bus.port} latency timer: {text}: {fix}"
    backend = connected(bus)  # The reply timeout is longer than the latency timer.
    assert [(each.text, each.fix) for each in lasting_notices(backend)] == [(text, fix)]
    backend.close()
    # If a port has a low-latency mode, the driver sets the timer to 1 ms.
    asked = []

    def low(_: serial.Serial, on: bool) -> None:
        asked.append(on)
        place.write_text("1\n")

    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", low)
    backend = connected(bus)
    assert asked == [True]
    assert lasting_notices(backend) == []
    backend.close()
    place.write_text("nonsense")
    assert "can't be read" in checks.check_latency_timer(bus.port, 1.0).text
    port = SerialPort(bus.port, 2_000_000, 1.0, low_latency=False)
    port.openPort()
    port.closePort()
    assert asked == [True]


def test_only_a_repair_changes_the_latency_of_an_adapter(bus, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, on: asked.append(on))
    settings = backend_settings(bus.port)
    check_servos(settings)
    save_registers(settings, tmp_path / "servos.json")
    restore_registers(settings, tmp_path / "servos.json")
    search(bus.port, (2_000_000,), 0.01)
    assert asked == []
    provision(settings)
    assert asked == [True]


# --- health ---------------------------------------------------------------------------------------


@pytest.fixture
def servos(bus: RunningBus, connect: Connect) -> DynamixelServos:
    return connect(bus)


def read(servos: Servos, reading: Reading) -> Reading:
    servos.read(reading)
    return reading


def test_temperature_and_supply_are_read_with_the_joints(bus, servos):
    reading = read(servos, Reading())
    assert reading.valid
    assert reading.temperature == [25.0, 25.0]
    assert reading.voltage == pytest.approx([12.75, 12.75], abs=0.06)
    bus.call(lambda: bus.servo(1).heat.warm(55.0))
    bus.call(lambda: setattr(bus.servo(0), "supply", 11.0))
    until(lambda: read(servos, reading).temperature[1] > 54.0)
    assert reading.voltage[0] == pytest.approx(11.0)
    assert reading.temperature[0] == 25.0


def test_both_kinds_of_read_give_the_same_readings(bus, servos, monkeypatch):
    # Only the first read includes all registers.
    monkeypatch.setattr(dynamixel, "_HEALTH_INTERVAL", math.inf)
    bus.call(lambda: bus.bus.plant.q.fill(0.2))
    wide = read(servos, Reading())
    narrow = read(servos, Reading())
    assert wide.temperature[0] > 0.0
    assert narrow.temperature[0] == 0.0
    assert np.abs(wide.q) == pytest.approx([0.2, 0.2], abs=0.002)
    assert narrow.q == pytest.approx(wide.q, abs=0.002)


def test_an_alert_names_the_hardware_error_and_arming_is_refused(bus, servos):
    reading = read(servos, Reading())
    assert reading.hardware == [0, 0]
    bus.fault("overload=2")
    until(lambda: read(servos, reading).alert)
    assert (reading.valid, reading.alert) == (True, 0b10)
    assert reading.hardware == [0, 1 << 5]
    with pytest.raises(ServoError, match=r"servo 2 \(right\): hardware error: overload"):
        servos.torque_on()
    assert not bus.servo(0).torque_on


class Loaded:
    """A hand whose joints do not move while the left motor draws 2 A."""

    q = dq = np.zeros(2)
    current = np.array([2.0, 0.0])

    def __init__(self) -> None:
        self.servo_heat = ServoHeat.of(Settings()), ServoHeat.of(Settings())
        self.driven: list[tuple[int, bool]] = []

    def measured_current(self, joint: int) -> float:
        return self.current.item(joint)

    def advance(self, t: float) -> None: ...

    def hold_torque_until(self, t: float) -> None: ...

    def drive(self, joint: int, mode: int, torque: bool, *_: Any) -> None:
        self.driven.append((joint, torque))


def test_simulated_servos_heat_up_with_their_current_and_shut_down():
    clock, hand = VirtualClock(), Loaded()
    servos = SimulatedServos(Settings(), hand, clock)
    servos.connect()
    reading = read(servos, Reading())
    assert reading.temperature == [25.0, 25.0]
    # The supply resistance is 0.35 Ω.
    assert reading.voltage == pytest.approx([12.05, 12.05], abs=0.06)
    servos.torque_on()
    while not read(servos, reading).alert:
        clock.sleep_until(clock.now() + 0.05)
        assert clock.now() < 400.0
    # The servo warms up by 55 K and has a heat capacity of 73 J/K. The power rises from 22.5 W to
    # 32 W as the copper heats up. The air removes part of the heat.
    assert 55.0 * 73.0 / 32.0 < clock.now() < 1.2 * 55.0 * 73.0 / 22.5
    assert (reading.alert, reading.hardware) == (0b01, [1 << 2, 0])
    assert reading.temperature == [80.0, 25.0]
    assert hand.driven[-2:] == [(0, False), (1, True)]
