"""Test that a short real-time soak test checks the bus, the memory use and lost messages."""

import copy
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from softfinger.daemon.profile.load import load
from tests.soak import hil
from tests.soak.rig import judge_wire


@pytest.mark.extended
def test_the_real_time_soak_checks_wire_memory_and_streams(monkeypatch):
    monkeypatch.setattr(hil, "_LOOK", 0.5)
    # Allow 30 MB, because all processes are still warming up.
    monkeypatch.setattr(hil, "_FLAT", 30.0)
    account = hil.soak(4.0)
    # On a busy machine, the emulated hand may be late, so the watchdog may trip late.
    assert [each for each in account.wrong if "without a packet" not in each] == []
    assert account.ticks > 0
    assert {"daemon", "hand", "recorder", "subscriber 3"} <= account.memory.keys()
    assert all(received > 0 for received, _ in (*account.received, account.recorded))
    assert all(each >= 0.0 for each in account.lateness())
    assert "subscribers' states, and lost" in str(account)


def test_a_growing_process_is_reported():
    account = hil.Account(seconds=30.0)
    account.looked = [(t, 0) for t in range(0, 30, 5)]
    account.memory = {"leaky": [10.0 + t for t in range(6)], "flat": [10.0] * 6}
    account.received = [(5, 0)]
    account.recorded = (5, 0)
    hil._conclude(account)
    assert [each.split()[0] for each in account.wrong] == ["leaky"]


def test_a_hand_that_rarely_holds_is_reported():
    for held, told in (40, []), (20, ["20 of 100 grasps came to hold"]):
        account = hil.Account(seconds=30.0, held=held)
        account.looked, account.received, account.recorded = [(0.0, 0)], [(5, 0)], (5, 0)
        account.done["grasp"] = 100
        hil._conclude(account)
        assert account.wrong == told


def servo(**changed: Any) -> dict[str, Any]:
    return {
        "torque": True,
        "stopped_by_watchdog": False,
        "goal_q": [-0.5, 1.0],
        "goal_current": [-1.2, 1.2],
        "goals_refused": 0,
        "torque_on": {"count": 1, "t": 0.0, "far": 0, "farthest": 0.0},
        "quiet": 0.001,
        "longest_quiet": 0.01,
        "watchdog_fired": {"count": 0, "t": None},
    } | changed


def judged(*servos: dict[str, Any]) -> str:
    settings = load(Path("hil"), Path("hand"))
    rig: Any = SimpleNamespace(settings=settings, report=lambda: {"servos": servos})
    return judge_wire(rig)


def test_the_wire_is_checked_by_its_record():
    assert judged(servo(), servo(goal_q=None, goal_current=None)) == ""
    for changed, told in (
        ({"goal_q": [-0.5, 1.01]}, "goal angles"),
        ({"goal_q": [-0.51, 0.0]}, "goal angles"),
        ({"goal_current": [-1.21, 0.0]}, "goal currents"),
        ({"goal_current": [0.0, math.nan]}, "goal currents"),
        ({"longest_quiet": 0.3}, "without a packet"),
        ({"goals_refused": 3}, "refused"),
    ):
        assert told in judged(servo(), servo(**changed))
        assert told in judged(servo(**changed), servo())
    far = copy.deepcopy(servo()["torque_on"]) | {"far": 1, "farthest": 0.3}
    assert "off its goal" in judged(servo(torque_on=far))
    fired = {"count": 1, "t": 0.1}
    assert judged(servo(longest_quiet=0.3, goals_refused=3, watchdog_fired=fired)) == ""
