"""The campaign of false measurements: that it judges by the plant, and sees what must not be."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from softfinger.tools.benchmarks.virtual_grip import VirtualGrip, Watch
from softfinger.tools.benchmarks.witnesses import (
    BOUNDED,
    CASES,
    SETTLES,
    GripTrial,
    WitnessCase,
    measure,
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


def test_a_watch_measures_forces_times_and_places() -> None:
    watch = Watch(10.0)
    for k, force in enumerate((10.0, 14.0, 15.0, 12.0, 13.5, 9.0, 9.0)):
        place = (0.0, 0.08 + (0.02 if k == 6 else 0.001 * k))
        watch.see(0.1 * k, (force, 10.0), place, torque=k != 6)
    assert watch.peak == 1.5
    assert watch.above == pytest.approx(0.1)  # from 0.1 to 0.2 s
    assert watch.slid == pytest.approx(0.005)
    assert watch.settled() == pytest.approx((1.25 + 1.1 + 1.175 + 0.95 + 0.95) / 5)


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
