"""Test the record of the bus traffic, read directly and through the control socket."""

import json
import struct

import pytest

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, frame
from tests.harness.emulated import emulated, send
from tests.harness.servos import RADIAN, BusClient, hand_bus

UNIT = by_name("XM430-W350").current_unit


class Hand(BusClient):
    """Client for a configured hand; higher counts close the left and open the right finger."""

    def __init__(self) -> None:
        super().__init__(hand_bus(10.0))
        self.t = 10.0

    def report(self, servo: int) -> dict:
        return next(each for each in self.bus.report(self.t) if each["id"] == servo)


def test_extreme_goals_are_recorded_including_refused_ones():
    hand = Hand()
    assert hand.report(1)["goal_q"] is None
    assert hand.report(1)["goal_current"] is None
    for current, counts in ((100, 2048), (50, 2148), (70, 1998)):
        assert hand.write(reg.GOAL_CURRENT, current, 2) == 0
        assert hand.write(reg.GOAL_POSITION, counts, 4) == 0
    left = hand.report(1)
    assert left["goal_current"] == pytest.approx([50 * UNIT, 100 * UNIT])
    assert left["goal_q"] == pytest.approx([-50 * RADIAN, 100 * RADIAN])
    assert left["goals_refused"] == 0
    assert hand.report(2)["goal_q"] is None
    # With torque off, write goals beyond the model's range and beyond the configured limit.
    assert hand.write(reg.GOAL_CURRENT, 5000, 2) == framing.DATA_RANGE
    assert hand.report(1)["goal_current"][1] == pytest.approx(5000 * UNIT)
    hand.write(reg.CURRENT_LIMIT, 200, 2)
    assert hand.write(reg.GOAL_CURRENT, -300, 2) == framing.DATA_LIMIT
    assert hand.report(1)["goal_current"][0] == pytest.approx(-300 * UNIT)
    assert hand.report(1)["goals_refused"] == 2
    hand.bus.forget(hand.t)
    assert hand.report(1)["goal_current"] is None
    assert hand.report(1)["goals_refused"] == 0


def test_goals_by_group_writes_and_indirect_addresses_are_recorded():
    hand = Hand()
    places = (reg.GOAL_CURRENT, reg.GOAL_CURRENT + 1, *range(116, 120))
    for servo in (1, 2):
        assert (
            hand.ask(framing.WRITE, struct.pack("<7H", reg.INDIRECT_ADDRESS, *places), servo)[0]
            == 0
        )
    goal = struct.pack("<hi", 10, 2048 + 40)
    data = struct.pack("<HHB", 224, 6, 1) + goal + b"\x02" + goal
    hand.bus.feed(frame(BROADCAST, framing.SYNC_WRITE, data), hand.t)
    assert hand.report(1)["goal_q"] == pytest.approx([40 * RADIAN] * 2)
    # The right joint counts in the opposite direction.
    assert hand.report(2)["goal_q"] == pytest.approx([-40 * RADIAN] * 2)
    assert hand.report(2)["goal_current"] == pytest.approx([-10 * UNIT] * 2)


def test_torque_on_far_from_the_goal_is_recorded():
    hand = Hand()
    hand.write(reg.GOAL_POSITION, 2048 + 10, 4)
    hand.write(reg.GOAL_CURRENT, 20, 2)
    assert hand.report(1)["goal_q"] is None, "without torque, the position is not a goal"
    hand.write(reg.TORQUE_ENABLE, 1, 1)
    hand.write(reg.TORQUE_ENABLE, 1, 1)  # Torque is already on.
    on = hand.report(1)["torque_on"]
    assert hand.report(1)["torque"]
    assert (on["count"], on["far"], on["t"]) == (1, 0, hand.t)
    assert on["farthest"] == pytest.approx(10 * RADIAN)
    hand.write(reg.GOAL_POSITION, 2048 + 10, 4)
    assert hand.report(1)["goal_q"] == pytest.approx([10 * RADIAN] * 2)
    hand.write(reg.TORQUE_ENABLE, 0, 1)
    hand.write(reg.GOAL_POSITION, 2048 + 500, 4)
    hand.write(reg.TORQUE_ENABLE, 1, 1)
    on = hand.report(1)["torque_on"]
    assert (on["count"], on["far"]) == (2, 1)
    assert on["farthest"] == pytest.approx(500 * RADIAN, rel=0.1)
    assert hand.report(2)["torque_on"]["count"] == 0


def test_silence_and_watchdog_trips_are_recorded():
    hand = Hand()
    hand.later(3.0)
    assert hand.report(1)["quiet"] is None
    assert hand.report(1)["longest_quiet"] == 0.0
    hand.write(reg.TORQUE_ENABLE, 1, 1)
    hand.write(reg.BUS_WATCHDOG, 5, 1)
    hand.later(0.04)
    hand.bus.feed(frame(2, framing.PING), hand.t)
    hand.later(0.03)
    state = hand.report(1)
    assert state["quiet"] == pytest.approx(0.03)
    assert state["longest_quiet"] == pytest.approx(0.04)
    assert state["watchdog"] == pytest.approx(0.1)
    assert state["watchdog_fired"] == {"count": 0, "t": None}
    fires = hand.t + 0.07
    hand.later(0.5)
    state = hand.report(1)
    assert state["stopped_by_watchdog"]
    assert state["watchdog"] is None
    assert state["watchdog_fired"]["count"] == 1
    assert state["watchdog_fired"]["t"] == pytest.approx(fires)
    assert state["longest_quiet"] == pytest.approx(0.53)


def test_the_report_is_sent_through_the_control_socket(tmp_path, capsys):
    settings = Settings.model_validate({"tactile": {"backend": "none"}})
    with emulated(tmp_path, settings=settings):
        assert send(tmp_path, "undervoltage=2 report forget") == 0
        told = json.loads(capsys.readouterr().out)
        assert [each["id"] for each in told["servos"]] == [1, 2]
        assert told["servos"][0]["torque"] is False
        assert told["monotonic"] > told["t"] > 0.0
        assert send(tmp_path, "report wrong") == 1
        assert "'wrong'" in capsys.readouterr().err
        assert send(tmp_path, "forget") == 0
        assert capsys.readouterr().out == ""
