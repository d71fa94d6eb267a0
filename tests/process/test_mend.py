"""Finding servos on a port and setting them up, against emulated ones on a pty."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from softfinger.daemon.errors import ServoError
from softfinger.daemon.loop.clock import RealClock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import mend as mending
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos import scanning
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.mend import mend
from softfinger.daemon.servos.scanning import FoundServo, scan
from softfinger.daemon.simulation.physics.free_joints import FreeJoints
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from tests.harness.servos import RunningBus


@pytest.fixture
def running() -> Iterator[Callable[..., RunningBus]]:
    """Starts buses of the settings' servos that end with the test."""
    buses: list[RunningBus] = []

    def start(**options: Any) -> RunningBus:
        now = time.monotonic()
        bus = ServoBus.from_settings(Settings(), FreeJoints(2, now), t=now, **options)
        buses.append(RunningBus(bus, baud=options.get("baud", 0)))
        return buses[-1]

    yield start
    for bus in buses:
        bus.close()


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bus shares this process's interpreter lock."""
    for module in (mending, scanning):
        monkeypatch.setattr(module, "PING_TIMEOUT", 0.1)
    monkeypatch.setattr(mending, "_SEARCH", 0.1)


def profile(bus: RunningBus, **servos: Any) -> Settings:
    values = {"backend": "dynamixel", "port": bus.path, "reply_timeout": 1.0} | servos
    return Settings.model_validate({"servos": values})


def test_factory_new_servos_become_usable(running: Callable[..., RunningBus]) -> None:
    bus = running(prepared=False)
    backend = DynamixelServos(profile(bus), RealClock())
    with pytest.raises(ServoError, match="doctor --fix"):
        backend.connect()
    assert mend(profile(bus)) == [
        "servo 1 (left): operating mode 3 → 5",
        "servo 1 (left): return delay 250 → 0",
        "servo 2 (right): operating mode 3 → 5",
        "servo 2 (right): return delay 250 → 0",
    ]
    assert mend(profile(bus)) == []
    backend.connect()
    backend.close()


def test_a_shut_down_servo_is_rebooted(running: Callable[..., RunningBus]) -> None:
    bus = running()
    bus.fault("overload=2")
    assert mend(profile(bus)) == [
        "servo 2 (right): rebooted, since it had a hardware error: overload"
    ]
    assert bus.memory(1)[reg.HARDWARE_ERROR_STATUS] == 0


def test_torque_goes_off_and_mute_servos_speak_again(running: Callable[..., RunningBus]) -> None:
    bus = running()

    def spoil() -> None:
        now = time.monotonic()
        bus.servo(0).write(reg.TORQUE_ENABLE, b"\x01", now)
        bus.servo(1).write(reg.STATUS_RETURN_LEVEL, b"\x00", now)

    bus.call(spoil)
    (line,) = mend(profile(bus))
    assert "servo 1 (left): torque off" in line
    assert not bus.servo(0).torque_on
    assert bus.memory(1)[reg.STATUS_RETURN_LEVEL] == 2


def test_a_drive_mode_that_stiffens_with_any_goal_is_mended(
    running: Callable[..., RunningBus],
) -> None:
    bus = running()
    memory = bus.servo(0).table.memory
    bus.call(lambda: memory.__setitem__(reg.DRIVE_MODE, 0b1001))
    assert mend(profile(bus)) == ["servo 1 (left): drive mode 9 → 1"]
    assert bus.memory(0)[reg.DRIVE_MODE] == 1


def test_what_can_not_be_mended_is_told_with_what_was(running: Callable[..., RunningBus]) -> None:
    bus = running(prepared=False)
    bus.fault("silent=2")
    with pytest.raises(ServoError) as caught:
        mend(profile(bus))
    assert str(caught.value).splitlines() == [
        "servo 2 (right): no answer at any rate: check its power and cable",
        "(done: servo 1 (left): operating mode 3 → 5)",
        "(done: servo 1 (left): return delay 250 → 0)",
    ]
    with pytest.raises(ServoError, match="is not an XL330-M288"):
        mend(profile(bus, model="XL330-M288"))


def test_a_scan_finds_servos_at_their_rate(running: Callable[..., RunningBus]) -> None:
    bus = running(baud=1_000_000)
    found = scan(bus.path, (57600, 1_000_000, 2_000_000), wait=0.1)
    assert found == [FoundServo(1, 1_000_000, 1020, 48), FoundServo(2, 1_000_000, 1020, 48)]
    assert found[0].model == "XM430-W350"
    with pytest.raises(ServoError, match="no such port"):
        scan("/dev/does-not-exist")
