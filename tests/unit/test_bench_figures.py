"""The benchmarks in short: their errors and bounds are true, and what they time does its work."""

from __future__ import annotations

import math

import pytest

from softfinger.daemon.profile.load import checked
from softfinger.tools.benchmarks import control, estimator, growth, reflex, scenes
from softfinger.tools.benchmarks.reflex import Overload
from softfinger.tools.benchmarks.rigs import merged


def test_lookups_have_their_errors() -> None:
    rows = estimator.lookups(1, 32).rows
    errors = {row["name"]: row[estimator.LOOKUP_ERROR] for row in rows}
    assert 1e-12 < errors["table to 1e-09"] <= 1e-9
    assert errors["table to 1e-12, called"] <= 1e-12


def test_estimates_stand_beside_the_bound() -> None:
    table = estimator.frames_to_contacts(1)
    error = {row["name"]: row.get(estimator.ERROR) for row in table.rows}
    limit = error["Cramér-Rao bound"]
    for way in ("warm", "cold"):
        assert 0.6 * limit < error[f"ml: {way}"] < 1.6 * limit
    assert error["decode: cobs"] is None


def test_growth_has_slopes_and_bounds() -> None:
    cells, errors = growth.cells((16, 24, 32), 1)
    assert all("∝ (cells a side)^" in note for note in cells.notes)
    assert len(cells.rows) == 21
    for row in errors.rows:
        assert 0.5 < row["median"] / row["Cramér-Rao bound"] < 2.0


def test_steps_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = ("no contact, no fit", "topics without subscribers")
    monkeypatch.setattr(scenes, "SCENES", {scenes.IDLE: scenes.SCENES[scenes.IDLE]})
    monkeypatch.setattr(scenes, "STEPS", {name: scenes.STEPS[name] for name in chosen})
    costs, savings = scenes.measure(brief=True)
    assert [row["name"] for row in costs.rows] == [scenes.IDLE]
    assert [row["name"] for row in savings.rows] == list(chosen)
    assert all(row["with"] > 0.0 and row["without"] > 0.0 for row in savings.rows)


def test_each_way_to_come_upright_has_settings_that_a_profile_may_have() -> None:
    for law, tips, _ in control.WAYS.values():
        assert checked(merged({"control": law}, tips)).tip.physics in ("springs", "solid")


def test_a_law_that_does_not_turn_the_object_leaves_it_askew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(control, "WAYS", {"energy": control.WAYS["energy"]})
    (table,) = control.measure(brief=True)
    assert [4.0 < row["median"] < 5.0 for row in table.rows] == [True]


def test_a_load_that_is_held_slides_and_one_that_is_lost_is_said() -> None:
    held = reflex.overloaded({}, 0.0, 13.0, 1)
    assert 0.0 < held.answer < 0.022
    assert 0.0 < held.slid < 0.02
    assert not held.lost
    weak = {"control": {"grip_raise_max": 0.0}, "simulation": {"object_mass": 0.1}}
    lost = reflex.overloaded(weak, 0.0, 18.0, 1)
    assert lost.lost
    assert 0.0 <= lost.said < 1.0


def test_overloads_are_summed_up() -> None:
    found = [
        Overload(0.010, 0.004, lost=False),
        Overload(math.inf, 0.030, lost=True, said=0.15),
        Overload(math.nan, 0.001, lost=False),
    ]
    row = reflex.row("r", found)
    assert (row["median"], row["unanswered"], row["slid mm"]) == (10.0, 1, 4.0)
    assert row["held %"] == pytest.approx(200.0 / 3.0)
    assert row["said ms"] == 150.0
    nothing = reflex.row("r", found[2:])
    assert "median" not in nothing
    assert math.isnan(nothing["said ms"])
