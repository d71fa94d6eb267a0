"""The fault campaign's short form, and that its judges see what must never be."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from softfinger.daemon.profile.load import load
from softfinger.daemon.safety.limits import LIMITS
from softfinger.tools.bench import ON_DEMAND
from softfinger.tools.benchmarks import faults, faults_trials
from softfinger.tools.benchmarks.faults import Outcome
from softfinger.tools.benchmarks.faults_cases import CASES, Case
from softfinger.tools.benchmarks.faults_rig import PROFILE, Rig, RigError
from softfinger.tools.benchmarks.faults_trials import Trial, judge_wire
from softfinger.tools.cli import main

BY_NAME = {case.name: case for case in CASES}
SHORT = (
    "replies corrupted, 10%",
    "one servo rebooted",
    "servos' port gone and back",
    "board's port gone and back",
    "garbage on the command socket",
    "daemon killed",
)


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with Rig() as made:
        yield made


@pytest.mark.parametrize("name", SHORT)
def test_one_trial_of_each_kind(rig: Rig, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faults_trials, "_READY_WITHIN", 100.0)  # s, until the hand grips
    outcome = faults._of_case(rig, BY_NAME[name], 1)
    # A busy machine may trip the hand; what must never be is no trial's excuse.
    assert outcome.passed == 1 or outcome.disturbed, outcome.failures
    assert outcome.trials == 1 or outcome.disturbed


def servo(**changed: Any) -> dict[str, Any]:
    return {
        "torque": True,
        "stopped_by_watchdog": False,
        "goal_q": [-0.5, 1.0],
        "goal_current": [-1.2, 1.2],
        "goals_refused": 0,
        "torque_on": {"count": 1, "t": 0.0, "far": 0, "farthest": 0.0, "current": 0.0},
        "quiet": 0.001,
        "longest_quiet": 0.01,
        "watchdog_fired": {"count": 0, "t": None},
    } | changed


def judged(*servos: dict[str, Any]) -> str:
    rig: Any = SimpleNamespace(
        settings=load(PROFILE, Path("hand")), report=lambda: {"servos": servos}
    )
    found = Trial(1)
    judge_wire(rig, found)
    return found.wrong


def test_the_wire_is_judged_by_its_record() -> None:
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


def test_a_grip_on_old_frames_is_seen() -> None:
    rig: Any = SimpleNamespace(settings=load(PROFILE, Path("hand")))
    state = {"torque": True, "fault": "", "mode": "holding"}
    state |= {side: {"frame_age_s": 0.02} for side in ("left", "right")}
    found = Trial(1)
    faults_trials._judge_age(rig, state, found)
    assert found.wrong == ""
    faults_trials._judge_age(rig, {**state, "right": {"frame_age_s": 0.3}}, found)
    assert "frame 0.300 s old" in found.wrong


@pytest.mark.parametrize(
    ("name", "trial", "missed"),
    [
        ("replies dropped, 1%", Trial(1), ""),
        ("replies dropped, 1%", Trial(1, fault="servos.silent", fault_s=0.1), "servos.silent"),
        ("replies dropped, 1%", Trial(1, safe_s=0.1), "no motor"),
        ("board silent", Trial(1), "no fault"),
        ("board silent", Trial(1, fault="tactile.silent"), "driven on"),
        ("board silent", Trial(1, fault="tactile.silent", safe_s=0.1), ""),
        ("board silent", Trial(1, fault="tactile.silent", safe_s=0.3), "driven for"),
        ("board silent", Trial(1, fault="tip.force", safe_s=0.1), "instead of tactile.silent"),
        ("board torn, 10%", Trial(1), ""),
        ("daemon killed", Trial(1, safe_s=0.1), ""),
        ("daemon killed", Trial(1), "driven on"),
        ("stop, 90% lost each way", Trial(1), "driven on"),
        ("stop, 90% lost each way", Trial(1, safe_s=0.1), ""),
        ("stop, 90% lost each way", Trial(1, fault="torque.off", safe_s=0.1), ""),
        ("stop, writes lost", Trial(1, safe_s=0.3), "driven for 0.300 s, 0.200 s allowed"),
    ],
)
def test_what_was_expected_is_told_from_what_was_not(name: str, trial: Trial, missed: str) -> None:
    faults_trials._judge(BY_NAME[name], trial)
    assert missed in trial.missed
    assert bool(trial.missed) == bool(missed)


def test_only_what_may_be_the_machines_doing_is_done_again() -> None:
    seeds: list[int] = []

    def one(seed: int) -> Trial:
        seeds.append(seed)
        busy = {"missed": "late", "aside_s": 1.0}
        return {1: Trial(1, **busy), 2: Trial(2), 3: Trial(3, wrong="crash", **busy)}.get(
            seed, Trial(seed, missed="late")
        )

    outcome = faults._all(Outcome("any", "works"), 3, one)
    assert seeds == [1, 2, 3, 4]
    assert (outcome.trials, outcome.passed, outcome.disturbed) == (3, 1, 1)
    assert outcome.failed
    assert ["seed 3" in outcome.failures[0], "late" in outcome.failures[1]] == [True, True]


def test_a_set_up_that_does_not_work_is_given_up() -> None:
    def broken(seed: int) -> Trial:
        raise RigError("no hand")

    outcome = faults._all(Outcome("any", "works"), 100, broken)
    assert (outcome.trials, outcome.passed) == (3, 0)


def test_the_table_tells_times_names_and_failures() -> None:
    outcome = Outcome("board silent", "fault", 0.14, 100, 99, 2, {"tactile.silent": 100})
    outcome.fault_s, outcome.safe_s, outcome.seconds = [0.1, 0.12], [0.101, 0.13], 60.0
    outcome.failures = ["seed 7, holding: no fault"]
    text = faults.table([outcome])
    for part in ("99/100", "100 / 120", "101 / 130", "140", "tactile.silent 100", "seed 7"):
        assert part in text
    assert outcome.as_dict()["safe_s"] == [0.101, 0.13]


def test_the_command_line(monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any) -> None:
    assert "faults" in ON_DEMAND
    assert main(["bench", "faults", "--only", "no such fault"]) == 2
    assert main(["bench", "faults", "--only", "("]) == 2
    asked = {}

    def measure(trials: int, only: str) -> list[Outcome]:
        asked.update(trials=trials, only=only)
        return [Outcome("board silent", "fault", trials=trials, passed=trials - 1)]

    monkeypatch.setattr(faults, "measure", measure)
    path = tmp_path / "faults.json"
    words = ["bench", "faults", "--only", "board", "--trials", "7", "--json", str(path)]
    assert main(words) == 1, "a failed trial is no success"
    assert asked == {"trials": 7, "only": "board"}
    assert "board silent" in path.read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        main(["bench", "faults", "--trials", "0"])
    capsys.readouterr()


def test_every_fault_that_latches_has_a_time_and_names_that_exist() -> None:

    rows = {row.name for row in LIMITS}
    assert len({case.name for case in CASES}) == len(CASES)
    for case in CASES:
        assert isinstance(case, Case)
        assert set(case.names) <= rows
        assert (case.expect in ("fault", "dies")) <= (case.within > 0.0)
