"""The campaign of false measurements: that it judges by the plant, and sees what must not be."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from softfinger.tools.benchmarks import witnesses
from softfinger.tools.benchmarks.virtual_grip import VirtualGrip, Watch
from softfinger.tools.benchmarks.witnesses import (
    BOUNDED,
    CASES,
    SETTLES,
    GripTrial,
    WitnessCase,
    measure,
    trial,
)

BY_NAME = {case.name: case for case in CASES}


def holding(force: float = 8.0) -> VirtualGrip:
    grip = VirtualGrip(1, random.Random(1), {})
    grip.command("arm")
    grip.loop.advance(0.1)
    grip.command("grasp", force=force)
    assert grip.until("holding", 3.0)
    return grip


def test_a_true_hand_meets_its_aim() -> None:
    (table,) = measure(2, "6 N: honest")
    (row,) = table.rows
    assert (row["met"], row["trials"], table.failed) == (2, 2, False)
    assert row["least"] == pytest.approx(1.0, abs=0.08)  # torque constants are off by up to 10 %
    assert row["peak"] < 1.15
    assert (row["named"], row["missed"], row["events"]) == ("", "", "")


def test_what_is_false_reaches_the_hand_and_the_force_is_the_plants() -> None:
    with holding() as grip:
        watch = grip.watched(4.0)
        grip.begin("left:gain=0.5@0.1..0.2 right:current=2")
        true = []
        for _ in range(100):
            grip.loop.advance(grip.loop.period)
            true.append(0.25 * max(grip.plant.force.tolist()))
        assert watch.peak == max(true)
        left, right = grip.plant.measurement_faults
        begin = grip.state.t - 0.2
        assert left("gain", begin + 0.15) == pytest.approx(0.75)
        assert right("current", begin) == 2.0
        reading = grip.state.reading.current
        assert reading[1] == pytest.approx(2.0 * grip.plant.current[1], rel=0.02)


def test_a_watch_measures_forces_times_and_places() -> None:
    watch = Watch(10.0)
    for k, force in enumerate((10.0, 14.0, 15.0, 12.0, 13.5, 9.0, 9.0)):
        place = (0.0, 0.08 + (0.02 if k == 6 else 0.001 * k))
        watch.see(0.1 * k, (force, 10.0), place, torque=k != 6)
    assert watch.peak == 1.5
    assert watch.above == pytest.approx(0.1)  # from 0.1 to 0.2 s
    assert watch.slid == pytest.approx(0.005)
    assert watch.settled() == pytest.approx((1.25 + 1.1 + 1.175 + 0.95 + 0.95) / 5)


def test_slips_and_answers_are_seen() -> None:
    with holding() as grip:
        assert math.isnan(grip.answer("push=0.1", 0.1))
        assert grip.answer("push=15", 0.5) > 0.0  # both bear 9.6 N


@pytest.mark.parametrize(
    ("aim", "changes", "missed"),
    [
        (SETTLES, {}, []),
        (SETTLES, {"settled": 1.25}, ["force"]),
        (SETTLES, {"settled": math.nan}, ["force"]),
        (SETTLES, {"events": [(1.0, "slip")]}, ["raised"]),
        (SETTLES, {"held": False}, ["not held"]),
        (SETTLES, {"events": [(1.0, "witness.right_sensor")]}, ["named wrongly"]),
        (BOUNDED, {"above": 0.06, "settled": 2.0}, ["too strong"]),
        (BOUNDED, {"events": []}, ["not named"]),
        (BOUNDED, {"events": [(1.31, "witness.left_sensor")]}, ["not named"]),
        (BOUNDED, {"events": [(0.2, "hand.width")]}, ["not named"]),
    ],
)
def test_what_misses_an_aim(aim: str, changes: dict[str, object], missed: list[str]) -> None:
    case = WitnessCase("a case", aim, 6.0, "left:drift=0.2@0..2", ("left_sensor",), comes=2.0)
    met = GripTrial(("left_sensor",), settled=1.0, events=[(1.29, "witness.left_sensor")])
    assert met.missed(case) == []
    assert replace(met, **changes).missed(case) == missed


def test_a_finger_is_drawn_and_what_it_measures_may_be_named(monkeypatch) -> None:
    monkeypatch.setattr(witnesses, "_LOOK", 0.5)
    case = BY_NAME["6 N: one servo's current x 2 at once"]
    found = [trial(case, seed) for seed in range(1, 5)]
    assert {each.false for each in found} == {("left_current",), ("right_current",)}
    assert all(each.held for each in found)
