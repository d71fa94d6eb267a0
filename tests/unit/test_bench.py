"""``softfinger bench``: tables, turns, slopes, comparison of runs, and the command line."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from softfinger.daemon.errors import Refused
from softfinger.tools import cli
from softfinger.tools.benchmarks import bench, faults, measuring, startup, tick
from softfinger.tools.benchmarks.measuring import (
    Report,
    Row,
    Subject,
    figure,
    interleave,
    slopes,
    slower,
)


def test_a_table_is_aligned_and_leaves_out_what_is_missing() -> None:
    rows = [
        {"name": "a", "x µs": 7.8e-6, "n": 3},
        {"name": "longer", "x µs": math.nan, "what": "w"},
    ]
    assert str(Report("times", rows, notes=("a note",))).splitlines() == [
        "times      x µs  n  what",
        "a       7.8e-06  3",
        "longer              w",
        "a note",
    ]


def test_a_figure_has_median_and_tail() -> None:
    row = figure("f", "s", range(101), 60.0)
    assert (row["median"], row["IQR"], row["p99"], row["n"]) == (50.0, 50.0, 99.0, 101)


def test_turns_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0]
    order: list[str] = []
    monkeypatch.setattr(measuring.time, "perf_counter_ns", lambda: clock[0])

    def subject(name: str, cost: int, calls: int) -> Subject:
        def run(repeat: int) -> None:
            order.append(name)
            clock[0] += cost * calls * repeat

        return Subject(run, calls)

    times = interleave({"a": subject("a", 100, 5), "b": subject("b", 7_000_000, 1)}, rounds=3)
    assert order == ["a", "a", "b", "b"] + ["a", "b"] * 3
    assert times["a"].tolist() == [100.0] * 3
    assert times["b"].tolist() == [7e6] * 3


def rows_of(stick: float, busy: float = 1.0, **medians: float) -> list[Row]:
    """A run's rows: yardsticks, and others of 2 % noise."""
    rows = [figure("yardstick", "µs", [stick] * 100) | {"table": ""}]
    rows += [figure("yardstick, long", "µs", [100.0 * stick * busy] * 100) | {"table": ""}]
    for name, median in medians.items():
        samples = [0.99 * median, median, 1.01 * median]
        rows.append(figure(name, "µs", samples) | {"table": "t"})
    return [{"measurement": "m", **row} for row in rows]


def test_what_became_slower_is_told_from_noise_and_from_a_slower_machine() -> None:
    old = rows_of(100.0, same=5.0, worse=5.0, gone=1.0)
    twice = slower(old, rows_of(200.0, same=10.1, worse=13.0, new=1.0))
    assert [row["name"] for row in twice.rows] == ["m: t: worse"]
    assert twice.rows[0]["ratio"] == pytest.approx(1.3)
    none = slower(old, rows_of(100.0, same=4.0, worse=5.1))
    assert str(none) == "slower than before, over the yardsticks: 0 of 2"
    assert slower(old, rows_of(100.0, busy=4.0, same=20.0, worse=5.0)).rows == []


def test_slopes_are_exponents_or_cost_for_each_more() -> None:
    rows = [figure(f"cells: {n}", "µs", [3.0 * n**2], cells=n) for n in (8, 16, 64)]
    rows += [figure(f"sensors: {n}", "µs", [5.0 * (n > 0) + 2.0 * n], cells=n) for n in (0, 1, 4)]
    assert slopes(rows, "cells") == (
        "  cells: ∝ (cells)^2.00, at the end ^2.00",
        "  sensors: +7 µs for 1 cells, +2 for each more",
    )


# The command line


@pytest.fixture
def canned(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A measurement of a tick that takes as long as is said."""

    def set_time(micros: float) -> None:
        rows = [figure("pipeline alone, nobody subscribed", "µs", [micros] * 5)]
        table = Report("tick", rows)
        monkeypatch.setattr(tick, "measure", lambda brief: [table])

    monkeypatch.setattr(bench, "PAGE", ("tick",))
    set_time(20.0)
    return set_time


def test_figures_are_kept_and_compared(
    canned: Callable[[float], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old.json"
    assert cli.main(["bench", "tick", "--json", str(old)]) == 0
    rows = json.loads(old.read_text(encoding="utf-8"))["rows"]
    assert [(row["measurement"], row["name"]) for row in rows] == [
        ("tick", "pipeline alone, nobody subscribed"),
        ("tick", "yardstick"),
        ("tick", "yardstick, long"),
    ]
    canned(2000.0)
    assert cli.main(["bench", "--against", str(old), "--plot", str(tmp_path / "x.png")]) == 3
    printed = capsys.readouterr().out
    assert "tick: pipeline alone" in printed, "the page"
    assert "slower than before, over the yardsticks: 1 of 1" in printed
    assert (tmp_path / "x.png").stat().st_size > 5_000


def test_a_measurement_that_fails_leaves_the_others(
    canned: Callable[[float], None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def let_go(brief: bool) -> list[Report]:
        raise Refused("the hand let go")

    monkeypatch.setattr(startup, "measure", let_go)
    assert cli.main(["bench", "startup", "tick"]) == 1
    printed = capsys.readouterr()
    assert "bench: startup: the hand let go" in printed.err
    assert "pipeline alone" in printed.out


def test_a_failed_campaign_is_no_success(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[int | None, str]] = []

    def measure(trials: int | None, only: str) -> list[Report]:
        asked.append((trials, only))
        return [Report("part", [{"name": "x"}], failed=trials == 7)]

    monkeypatch.setattr(faults, "measure", measure)
    assert cli.main(["bench", "campaign", "faults"]) == 0
    assert cli.main(["bench", "campaign", "faults", "--trials", "7", "--only", "board"]) == 1
    assert asked == [(None, ""), (7, "board")]
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["contct"], "found 'contct', expected one of contact"),
        (["faults"], "it is a campaign, `bench campaign faults`"),
        (["campaign"], "'campaign' alone, expected one of faults, witnesses"),
        (
            ["campaign", "faults", "--only", "no such fault"],
            "no case of faults has this in its name",
        ),
        (["campaign", "faults", "--plot", "x.png"], "campaigns have no picture"),
        (["tick", "--full"], "--full: only reflex has it"),
        (["tick", "--against", "/nowhere.json"], "no figures of `bench --json`"),
    ],
)
def test_refusals_come_before_the_measurements(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert "measuring" not in error


def test_a_picture_needs_matplotlib(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["bench", "contact", "--plot", "x.png"]) == 2
    assert "pip install 'softfinger[plot]'" in capsys.readouterr().err


def test_a_number_of_trials_is_a_whole_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["bench", "campaign", "faults", "--trials", "0"])
    assert "expected a whole number above 0" in capsys.readouterr().err
