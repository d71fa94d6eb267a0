"""Temperature, supply and hardware errors of the servos, from the wire to the limits' table."""

import math
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import dynamixel
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat
from softfinger.daemon.types import Reading
from tests.conftest import until
from tests.harness.servos import RunningBus
from tests.process.conftest import Connect


@pytest.fixture
def servos(bus: RunningBus, connect: Connect) -> DynamixelServos:
    return connect(bus)


def read(servos: Servos, reading: Reading) -> Reading:
    servos.read(reading)
    return reading


def test_temperature_and_supply_come_with_the_joints(bus, servos):
    reading = read(servos, Reading())
    assert reading.valid
    assert reading.temperature == [25.0, 25.0]
    assert reading.voltage == pytest.approx([12.75, 12.75], abs=0.06)
    bus.call(lambda: bus.servo(1).health.heat.warm(55.0))
    bus.call(lambda: setattr(bus.servo(0).health, "supply", 11.0))
    until(lambda: read(servos, reading).temperature[1] > 54.0)
    assert reading.voltage[0] == pytest.approx(11.0)
    assert reading.temperature[0] == 25.0


def test_both_kinds_of_read_give_the_same_joints(bus, servos, monkeypatch):
    monkeypatch.setattr(dynamixel, "_HEALTH_EVERY", math.inf)  # one wide read, and no other
    wide = read(servos, Reading())
    narrow = read(servos, Reading())
    assert wide.temperature[0] > 0.0
    assert narrow.temperature[0] == 0.0
    assert narrow.q == pytest.approx(wide.q, abs=0.002)
    assert servos.counters()["timeouts"] == 0


def test_an_alert_tells_which_hardware_error_it_is_and_arming_is_refused(bus, servos):
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
    """A hand that stands, with 2 A through its left joint."""

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


def test_simulated_servos_warm_with_their_current_and_shut_down():
    clock, hand = VirtualClock(), Loaded()
    servos = SimulatedServos(Settings(), hand, clock)
    servos.connect()
    reading = read(servos, Reading())
    assert reading.temperature == [25.0, 25.0]
    assert reading.voltage == pytest.approx([12.05, 12.05], abs=0.06)  # 0.35 Ω on the way
    servos.torque_on()
    while not read(servos, reading).alert:
        clock.sleep_until(clock.now() + 0.05)
        assert clock.now() < 400.0
    # 55 K of 73 J/K by 22.5 W, which is 32 W where copper is hot; and some goes into the air.
    assert 55.0 * 73.0 / 32.0 < clock.now() < 1.2 * 55.0 * 73.0 / 22.5
    assert (reading.alert, reading.hardware) == (0b01, [1 << 2, 0])
    assert reading.temperature == [80.0, 25.0]
    assert hand.driven[-2:] == [(0, False), (1, True)]
