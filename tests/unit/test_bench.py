"""Test the errors, bounds and verdicts of short benchmark runs."""

import json
import math
from dataclasses import replace
from functools import partial
from timeit import Timer

import pytest

from softfinger.daemon.errors import Refused
from softfinger.tools import cli
from softfinger.tools.benchmarks import bench, control, estimator, faults, measuring, reflex, tick
from softfinger.tools.benchmarks.faults import BOUNDED, SETTLES, GripTrial, measure
from softfinger.tools.benchmarks.measuring import Report, figure, interleave
from softfinger.tools.benchmarks.rigs import GripCase, RigError, Watch


def test_interleaved_timing(monkeypatch):
    clock = [0.0]
    order: list[str] = []
    monkeypatch.setattr(measuring, "Timer", partial(Timer, timer=lambda: clock[0]))

    def run(name: str, cost: float) -> None:
        order.append(name)
        clock[0] += cost

    subjects = {"a": partial(run, "a", 1e-4), "b": partial(run, "b", 7e-3)}
    times = interleave(subjects, rounds=3)
    assert order == ["a", "a", "b", "b"] + ["a"] * 4 + ["b"] + ["a"] * 4 + ["b"] + ["a"] * 4 + ["b"]
    assert times["a"] == pytest.approx([1e5] * 3)
    assert times["b"] == pytest.approx([7e6] * 3)


# The command line


@pytest.fixture
def canned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the tick measurement with a stored result."""
    table = Report("tick", [figure("pipeline alone, nobody subscribed", "µs", [20.0] * 5)])
    monkeypatch.setattr(tick, "measure", lambda brief: [table])
    monkeypatch.setattr(bench, "PAGE", ("tick",))


def test_results_are_stored(canned, tmp_path, capsys):
    old = tmp_path / "old.json"
    assert cli.main(["bench", "tick", "--json", str(old)]) == 0
    rows = json.loads(old.read_text(encoding="utf-8"))["rows"]
    assert [(row["measurement"], row["name"]) for row in rows] == [
        ("tick", "pipeline alone, nobody subscribed"),
    ]
    assert cli.main(["bench"]) == 0
    assert "tick: pipeline alone" in capsys.readouterr().out, "results must be printed"


def test_infinite_results_are_stored_as_null(tmp_path, monkeypatch):
    never = reflex.row("x", [reflex.Overload(math.inf, 0.0, lost=True, said=math.inf)])
    assert never["reported ms"] == math.inf
    monkeypatch.setattr(tick, "measure", lambda brief: [Report("tick", [never])])
    file = tmp_path / "found.json"
    assert cli.main(["bench", "tick", "--json", str(file)]) == 0
    (row,) = json.loads(file.read_text(encoding="utf-8"), parse_constant=pytest.fail)["rows"]
    assert row["reported ms"] is None


def test_a_selection_without_cases_is_reported(capsys):
    # The brief benchmark omits the grips with each sensor.
    assert cli.main(["bench", "robustness", "--brief", "--only", "velostat"]) == 1
    assert "robustness: --only velostat: no case was run; omit --brief" in capsys.readouterr().err


def test_a_failed_measurement_does_not_affect_the_others(canned, monkeypatch, capsys):
    def let_go(brief: bool) -> list[Report]:
        raise Refused("the hand let go")

    monkeypatch.setattr(control, "measure", let_go)
    assert cli.main(["bench", "control", "tick"]) == 1
    printed = capsys.readouterr()
    assert "bench: control: the hand let go" in printed.err
    assert "pipeline alone" in printed.out


def test_a_missed_aim_is_not_a_success(monkeypatch, capsys):
    asked: list[tuple[int | None, str]] = []

    def measure(brief: bool, trials: int | None, only: str, sweep: object) -> list[Report]:
        asked.append((trials, only))
        return [Report("part", [{"name": "x"}], failed=trials == 7)]

    monkeypatch.setattr(faults, "measure", measure)
    assert cli.main(["bench", "faults"]) == 0
    assert cli.main(["bench", "faults", "--trials", "7", "--only", "no fault"]) == 1
    assert asked == [(None, ""), (7, "no fault")]
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["tik"], "found 'tik', expected one of estimator"),
        (
            ["faults", "--only", "no such fault"],
            "no case in faults has a name that contains this text",
        ),
        (["tick", "--full"], "--full: valid only for reflex"),
        (["--trials", "3"], "--trials: valid only for faults or robustness"),
    ],
)
def test_invalid_options_are_refused_before_measuring(words, text, capsys):
    assert cli.main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert "measuring" not in error


def test_table_lookups_have_their_documented_errors():
    rows = estimator.lookups(1, 32).rows
    errors = {row["name"]: row[estimator.LOOKUP_ERROR] for row in rows}
    assert errors["table to 1e-09"] <= 1e-9 < errors["table to 1e-06, called"] <= 1e-6


def test_estimates_are_reported_with_the_bound():
    table = estimator.frames_to_contacts(1)
    error = {row["name"]: row.get(estimator.ERROR) for row in table.rows}
    limit = error["Cramér-Rao bound"]
    for way in ("warm", "cold"):
        assert 0.6 * limit < error[f"ml: {way}"] < 1.6 * limit
    assert error["decode: cobs"] is None


ASKEW = {"object_angle": math.radians(5.0)}


@pytest.mark.parametrize(
    ("way", "low", "high"),
    [
        (control.WAYS["energy"], 4.0, 5.0),
        (control.LATE_LIMITS["two-phased, 0.5 Hz, 0 ms"], 0.0, 0.2),
        (control.LATE_LIMITS["two-phased, 0.5 Hz, 300 ms"], 0.0, 1.0),
        (control.LATE_LIMITS["energy, 0.5 Hz, 300 ms"], 0.0, 1.0),
        (control.LATE_LIMITS["energy, 4 Hz, 0 ms"], 0.0, 0.25),
        (control.LATE_LIMITS["energy, 4 Hz, 100 ms"], 5.0, math.inf),
        (control.LATE_LIMITS["two-phased, 4 Hz, 100 ms"], 5.0, math.inf),
        (control.LATE_TIPS["half as stiff along the face, 300 ms"], 0.0, 1.0),
        (control.LIMITS["torque constants 5 % apart"], 1.5, 3.0),
        (control.LIMITS["tips without tangential coupling"], 0.2, 1.2),
    ],
)
def test_residual_angle_error_of_a_control_law(way, low, high):
    # The control loop is stable if the product of its delay and integral bandwidth is below π/2. An
    # unstable loop may drop the object.
    left = control.left(way, ASKEW)
    assert low <= (math.inf if left is None else left) <= high


def test_an_object_that_is_not_held_is_counted_separately():
    far = {"object_position": (0.0, 0.4)}
    row = control.row("energy", control.WAYS["energy"], [ASKEW, ASKEW | far])
    assert (row["n"], row["not held"]) == (1, 1)


def test_a_failed_part_does_not_affect_the_others(monkeypatch, capsys):
    def let_go(title: str, **_: object) -> Report:
        raise RigError("the hand failed to grip the object: grasping")

    monkeypatch.setattr(tick, "_in_turns", let_go)
    monkeypatch.setattr(tick, "in_the_loop", lambda title, **_: Report(title, [{"name": "x"}]))
    assert cli.main(["bench", "tick", "--brief"]) == 1
    printed = capsys.readouterr()
    assert "bench: tick: tick: the hand failed to grip the object: grasping\n" in printed.err
    assert "the simulated hand" in printed.out
    assert printed.out.count("hardware in the loop") == 2


def test_a_failed_grip_is_counted():
    outcomes = iter([None, (0.01, 0.002, False)])
    (row,) = reflex._table("springs", [(0.0, 13.0, "push")], 2, outcomes).rows
    assert (row["no grip"], row["held %"], row["median"]) == (1, 100.0, 10.0)


@pytest.mark.extended
def test_a_held_load_slides_and_a_lost_load_is_reported():
    held = reflex.overloaded({}, 0.0, 13.0, 1)
    assert 0.0 < held.answer < 0.022
    assert 0.0 < held.slid < 0.02
    assert not held.lost
    # One joint sticks, so it moves only a quarter as far as the other joint.
    sticking = reflex.overloaded({"simulation": {"object_mass": 0.5}}, 6.0, 15.0, 1)
    assert (sticking.answer < 0.022, sticking.slid < 0.012, sticking.lost) == (True, True, False)
    weak = {"control": {"grip_raise_max": 0.0}, "simulation": {"object_mass": 0.1}}
    lost = reflex.overloaded(weak, 0.0, 18.0, 1)
    assert lost.lost
    assert 0.0 <= lost.said < 1.0


@pytest.mark.extended
def test_an_ideal_hand_meets_its_aim():
    (table,) = measure(trials=2, only="6 N: no fault")
    (row,) = table.rows
    assert (row["met"], row["trials"], table.failed) == (2, 2, False)
    # The torque constants may be off by up to 10 %.
    assert row["lowest"] == pytest.approx(1.0, abs=0.08)
    assert row["peak"] < 1.15
    assert (row["reported"], row["missed"], row["events"]) == ("", "", "")


def test_a_watch_measures_forces_times_and_positions():
    watch = Watch(10.0)
    for k, force in enumerate((10.0, 14.0, 15.0, 12.0, 13.5, 9.0, 9.0)):
        place = (0.0, 0.08 + (0.02 if k == 6 else 0.001 * k))
        watch.see(0.1 * k, (force, 10.0), place, torque=k != 6, goal=10.0)
    assert watch.peak == 1.5
    assert watch.above == pytest.approx(0.1)  # The force exceeds the limit from 0.1 s to 0.2 s.
    assert watch.slid == pytest.approx(0.005)
    assert watch.settled() == pytest.approx((1.25 + 1.1 + 1.175 + 0.95 + 0.95) / 5)


@pytest.mark.parametrize(
    ("aim", "changes", "missed"),
    [
        (SETTLES, {}, []),
        (SETTLES, {"settled": 1.25}, ["force"]),
        (SETTLES, {"settled": math.nan}, ["force"]),
        (SETTLES, {"events": [(1.0, "slip")]}, ["increased"]),
        (SETTLES, {"held": False}, ["not held"]),
        (SETTLES, {"events": [(1.0, "consistency.right_sensor")]}, ["wrong report"]),
        (BOUNDED, {"above": 0.06, "settled": 2.0}, ["too much force"]),
        (BOUNDED, {"events": []}, ["not reported"]),
        (BOUNDED, {"events": [(1.31, "consistency.left_sensor")]}, ["not reported"]),
        (BOUNDED, {"events": [(0.2, "hand.width")]}, ["not reported"]),
    ],
)
def test_missed_aims_are_listed(aim, changes, missed):
    case = GripCase("a case", 6.0, aim=aim, words="left:drift=0.2@0..2", false=("left_sensor",))
    met = GripTrial(
        ("left_sensor",), comes=2.0, settled=1.0, events=[(1.29, "consistency.left_sensor")]
    )
    assert met.missed(case) == []
    assert replace(met, **changes).missed(case) == missed
