"""``softfinger bench``: tables, turns, slopes, comparison of runs, and the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softfinger.daemon.errors import Refused
from softfinger.tools import cli
from softfinger.tools.benchmarks import bench, growth, measuring, tick, witnesses
from softfinger.tools.benchmarks.measuring import (
    Report,
    Subject,
    figure,
    interleave,
    slopes,
)


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


def test_slopes_are_exponents_or_cost_for_each_more() -> None:
    rows = [figure(f"cells: {n}", "µs", [3.0 * n**2], cells=n) for n in (8, 16, 64)]
    rows += [figure(f"sensors: {n}", "µs", [5.0 + 2.0 * n], cells=n) for n in (0, 1, 4)]
    assert slopes(rows, "cells") == (
        "  cells: ∝ (cells)^2.00",
        "  sensors: +2 µs for each more",
    )


# The command line


@pytest.fixture
def canned(monkeypatch: pytest.MonkeyPatch) -> None:
    """A measurement of a tick that takes no time."""
    table = Report("tick", [figure("pipeline alone, nobody subscribed", "µs", [20.0] * 5)])
    monkeypatch.setattr(tick, "measure", lambda brief: [table])
    monkeypatch.setattr(bench, "PAGE", ("tick",))


def test_figures_are_kept(canned: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = tmp_path / "old.json"
    assert cli.main(["bench", "tick", "--json", str(old)]) == 0
    rows = json.loads(old.read_text(encoding="utf-8"))["rows"]
    assert [(row["measurement"], row["name"]) for row in rows] == [
        ("tick", "pipeline alone, nobody subscribed"),
    ]
    assert cli.main(["bench"]) == 0
    assert "tick: pipeline alone" in capsys.readouterr().out, "the page"


def test_a_measurement_that_fails_leaves_the_others(
    canned: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def let_go(brief: bool) -> list[Report]:
        raise Refused("the hand let go")

    monkeypatch.setattr(growth, "measure", let_go)
    assert cli.main(["bench", "growth", "tick"]) == 1
    printed = capsys.readouterr()
    assert "bench: growth: the hand let go" in printed.err
    assert "pipeline alone" in printed.out


def test_a_failed_campaign_is_no_success(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[int | None, str]] = []

    def measure(trials: int | None, only: str, sweep: object) -> list[Report]:
        asked.append((trials, only))
        return [Report("part", [{"name": "x"}], failed=trials == 7)]

    monkeypatch.setattr(witnesses, "measure", measure)
    assert cli.main(["bench", "campaign", "witnesses"]) == 0
    assert cli.main(["bench", "campaign", "witnesses", "--trials", "7", "--only", "honest"]) == 1
    assert asked == [(None, ""), (7, "honest")]
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["tik"], "found 'tik', expected one of estimator"),
        (["witnesses"], "it is a campaign, `bench campaign witnesses`"),
        (["campaign"], "'campaign' alone, expected one of witnesses"),
        (
            ["campaign", "witnesses", "--only", "no such lie"],
            "no case of witnesses has this in its name",
        ),
        (["tick", "--full"], "--full: only reflex has it"),
    ],
)
def test_refusals_come_before_the_measurements(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert "measuring" not in error
