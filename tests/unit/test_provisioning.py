"""Test the search, identification and configuration of servos on an emulated line."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos import provisioning
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.servos.protocol import UNPACED_TIMEOUT, PacketHandler, PortLost, ServoLine
from softfinger.daemon.servos.provisioning import (
    Found,
    FoundServo,
    Garbled,
    plan,
    provision,
    search,
)
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.testing.emulated import FreeJoints
from tests.harness.servos import DirectPort

MODEL = by_name("XM430-W350")
RATES = MODEL.baud_rates
HOME = 2_000_000


# --- identification
# ---------------------------------------------------------------------------------


def servo(servo_id: int, baud: int = HOME, number: int = MODEL.number) -> FoundServo:
    return FoundServo(servo_id, baud, number, 48)


BOTH: dict[str, Any] = {}
ONLY_LEFT = {"scene": {"fingers": ("left",)}}
ONLY_RIGHT = {"scene": {"fingers": ("right",)}}
OTHER_IDS = {**ONLY_LEFT, "servos": {"ids": (11, 12)}}


@pytest.mark.parametrize(
    ("settings", "found", "told"),
    [
        # Both servos are configured.
        (BOTH, [servo(1), servo(2)], []),
        (BOTH, [servo(1), servo(2), servo(9)], ["stranger 9@2000000"]),
        # The ID identifies a servo, even at another baud rate.
        (
            BOTH,
            [servo(1, 57600), servo(2, 57600)],
            ["0: 57600 → 2000000 baud", "1: 57600 → 2000000 baud"],
        ),
        # If one servo is missing and another servo is unexpected, the search identifies the
        # unexpected servo as the missing one.
        (BOTH, [servo(1), servo(1, 57600)], ["1: ID 1 → 2, 57600 → 2000000 baud"]),
        (BOTH, [servo(1), servo(7)], ["1: ID 7 → 2"]),
        (OTHER_IDS, [servo(1, 57600)], ["0: ID 1 → 11, 57600 → 2000000 baud"]),
        # A servo cannot be the missing servo if it has the ID of a finger that is not in the scene.
        # A servo with the factory ID and baud rate may belong to any finger.
        (ONLY_LEFT, [servo(2)], ["missing 0", "stranger 2@2000000"]),
        (ONLY_RIGHT, [servo(1)], ["missing 1", "stranger 1@2000000"]),
        (ONLY_RIGHT, [servo(1, 57600)], ["1: ID 1 → 2, 57600 → 2000000 baud"]),
        # Ambiguous cases.
        (BOTH, [servo(7)], ["missing 0", "missing 1", "stranger 7@2000000"]),
        (
            BOTH,
            [servo(1), servo(7), servo(8)],
            ["missing 1", "stranger 7@2000000", "stranger 8@2000000"],
        ),
        (BOTH, [servo(1), servo(7, number=1200)], ["missing 1", "stranger 7@2000000"]),
        (
            BOTH,
            [servo(1, 57600), servo(1, 1_000_000), servo(2)],
            ["missing 0", "stranger 1@57600", "stranger 1@1000000"],
        ),
        # An emulator without line timing replies at every baud rate.
        (BOTH, [servo(servo_id, rate) for servo_id in (1, 2) for rate in RATES], []),
        # If a servo's replies are garbled, the servo is not configured. The servo's ID is not
        # assigned to another servo.
        (BOTH, [servo(1, 57600), Garbled(1, 57600)], ["missing 0", "missing 1"]),
        (
            BOTH,
            [servo(2), servo(9, 57600), Garbled(1, HOME)],
            ["missing 0", "stranger 9@57600"],
        ),
    ],
)
def test_servos_are_identified(settings, found, told):
    servos = tuple(each for each in found if isinstance(each, FoundServo))
    garbled = tuple(each for each in found if isinstance(each, Garbled))
    what = plan(Found(servos, garbled), Settings.model_validate(settings), MODEL)
    changes = [f"{each.finger}: {each}" for each in what.changes]
    missing = [f"missing {finger}" for finger in what.missing]
    assert changes + missing + [f"stranger {s.id}@{s.baud}" for s in what.strangers] == told


# --- search and configuration
# -----------------------------------------------------------------------


class Bus:
    """Bus with the servos of the settings on free joints; ``silent`` servos are unplugged."""

    def __init__(self, baud: int = HOME, **options: Any) -> None:
        servos = {"backend": "dynamixel", "open_timeout": 0.001}
        self.settings = Settings.model_validate({"servos": servos})
        self.bus = ServoBus.from_settings(self.settings, FreeJoints(2), baud=baud, **options)
        self.servos = self.bus.servos
        self.t = 0.0

    @contextlib.contextmanager
    def line(self, path: str, baud: int, low_latency: bool = False) -> Iterator[ServoLine]:
        if baud < 0:
            raise ServoError("no such rate")
        port = DirectPort(self.bus, baud, UNPACED_TIMEOUT, self.t)
        yield ServoLine(port)
        self.t = port.t

    def provision(self, **servos: Any) -> tuple[list[str], list[str]]:
        result = provision(self.settings.changed(servos=servos))
        done = [str(each) for each in result if each.status == "fixed"]
        return done, [str(each) for each in result if each.status == "warn"]

    def addresses(self) -> list[tuple[int, int]]:
        return [(each.id, each.baud) for each in self.servos]


@pytest.fixture
def wired(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Bus]:
    """Return a function that creates a bus and connects it to the line that the test opens."""

    def make(**options: Any) -> Bus:
        bus = Bus(**options)
        monkeypatch.setattr(provisioning, "open_line", bus.line)
        return bus

    return make


class RestartingPort(DirectPort):
    """Port of an adapter that restarts when it is opened and loses the first packets."""

    lost = 10  # number of packets that will be lost

    def send(self, packet: bytes, reply: int = 0, until: float = math.inf) -> bool:
        self.lost -= 1
        return self.lost >= 0 or super().send(packet, reply, until)


MODE_AND_DELAY = ["operating mode 3 → 5", "return delay 250 → 0"]
LEFT, RIGHT = "servo 1 (left)", "servo 2 (right)"


def named(name: str, *changes: str) -> list[str]:
    return [f"{name}: {change}" for change in changes]


def test_a_search_finds_servos_at_their_rate(wired):
    wired(baud=1_000_000)
    # The port does not support a rate of -1.
    found = search("line", (-1, 57600, 1_000_000, 2_000_000))
    assert found.servos == tuple(FoundServo(i, 1_000_000, 1020, 48) for i in (1, 2))
    assert str(found.servos[0]) == "ID 1 at 1000000 baud: XM430-W350, firmware 48"
    with pytest.raises(ServoError, match="no such rate"):
        search("line", (-1,))


def test_a_search_recognises_servos_of_protocol_1(wired):
    bus = wired(baud=57600)
    bus.servos[0].table.set(reg.PROTOCOL_TYPE, 1)
    bus.servos[1].silent = True
    found = search("line", (57600, HOME))
    assert (found.servos, found.old) == ((), (57600,))
    _, problems = bus.provision()
    assert problems[0].startswith(
        "a servo at 57600 baud: replies in Protocol 1.0, expected Protocol 2.0: "
    )


def test_a_port_that_disappears_ends_a_search(wired, monkeypatch):
    def gone(*_: object) -> None:
        raise PortLost("the port is lost")

    wired()
    monkeypatch.setattr(ServoLine, "ping_all", gone)
    with pytest.raises(PortLost):
        search("line")


def test_two_factory_servos_are_configured_one_after_the_other(wired):
    bus = wired(baud=57600, ids=(1, 1), factory=True)
    bus.servos[1].silent = True
    assert bus.provision() == (
        named(LEFT, "57600 → 2000000 baud", *MODE_AND_DELAY),
        [f"{RIGHT}: no reply at any baud rate: check the power supply and the cable"],
    )
    assert bus.addresses() == [(1, HOME), (1, 57600)]
    bus.servos[1].silent = False
    done = named(RIGHT, "ID 1 → 2, 57600 → 2000000 baud", *MODE_AND_DELAY)
    assert bus.provision() == (done, [])
    assert bus.addresses() == [(1, HOME), (2, HOME)]
    assert bus.provision() == ([], [])
    assert not any(each.torque_on for each in bus.servos)


def test_a_repair_waits_for_an_adapter_that_restarts(wired, monkeypatch):
    bus = wired(factory=True)
    monkeypatch.setitem(globals(), "DirectPort", RestartingPort)
    done = [*named(LEFT, *MODE_AND_DELAY), *named(RIGHT, *MODE_AND_DELAY)]
    assert bus.provision(open_timeout=60.0) == (done, [])


def test_factory_servos_with_the_same_id_are_reported_and_not_changed(wired):
    bus = wired(baud=57600, ids=(1, 1), factory=True)
    before = [bytes(each.table.memory[: reg.RAM]) for each in bus.servos]
    assert search("line", (57600, HOME)).garbled == (Garbled(1, 57600),)
    done, problems = bus.provision()
    assert done == []
    assert "several servos have this ID (the factory setting)" in problems[0]
    assert [bytes(each.table.memory[: reg.RAM]) for each in bus.servos] == before


@pytest.mark.parametrize(
    ("fault", "register", "value", "done"),
    [
        ("overload", None, 0, f"{RIGHT}: rebooted (hardware error: overload)"),
        (
            "",
            reg.TORQUE_ENABLE,
            1,
            f"{LEFT}: torque switched off, because the EEPROM is locked while torque is on",
        ),
        ("", reg.DRIVE_MODE, 0b1100, f"{LEFT}: drive mode 12 → 4"),
        ("", reg.STATUS_RETURN_LEVEL, 0, f"{LEFT}: status return level 0 → 2"),
        ("", reg.GOAL_PWM, 500, f"{LEFT}: goal PWM 500 → 885"),
    ],
)
def test_configured_registers(wired, fault, register, value, done):
    bus = wired()
    if fault:
        bus.bus.fault(fault, 2, 0.0)
    if register is not None:
        bus.servos[0].table.set(register, value)
    bus.servos[0].table.set(reg.BUS_WATCHDOG, 255)  # The watchdog has stopped the servo.
    assert bus.provision() == ([done], [])
    assert bus.servos[1].table.get(reg.HARDWARE_ERROR_STATUS) == 0
    assert not bus.servos[0].torque_on
    assert bus.servos[0].table.get(reg.STATUS_RETURN_LEVEL) == 2


def test_a_register_that_only_the_settings_can_correct_is_not_reported_as_fixed(wired):
    """With the zero position near 0, the joint range includes negative positions."""
    done, problems = wired().provision(mode="position", zero=(50, 2048))
    assert done == named(LEFT, "operating mode 5 → 3") + named(RIGHT, "operating mode 5 → 3")
    assert len(problems) == 1
    assert problems[0].startswith(f"{LEFT}: min position limit is 0, the joint requires -276")


def test_a_reboot_without_effect_is_not_reported_as_a_correction(wired, monkeypatch):
    bus = wired()
    bus.bus.plant.q[0] = 4.0 * math.pi
    monkeypatch.setattr(PacketHandler, "reboot", lambda *_: None)
    done, (problem,) = bus.provision()
    assert done == []
    assert "position wrong by at least one turn" in problem
    assert "even after a reboot" in problem


def test_failed_and_successful_configurations_are_both_reported(wired):
    bus = wired(factory=True)
    bus.bus.fault("silent", 2, 0.0)
    missing = f"{RIGHT}: no reply at any baud rate: check the power supply and the cable"
    assert bus.provision() == (named(LEFT, *MODE_AND_DELAY), [missing])
    _, problems = bus.provision(model="XL330-M288")
    assert f"{LEFT}: is an XM430-W350, expected an XL330-M288: set servos.model" in problems
