"""Published figures beside the model: each figure computed another way here."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from softfinger.tools.paper import validate
from softfinger.tools.paper.validate import Beside


@pytest.fixture(scope="module")
def rows() -> dict[str, Beside]:
    return {each.quantity: each for each in validate.comparisons()}


def test_every_row_has_its_source_and_a_verdict_and_every_disagreement_a_reason(
    rows: dict[str, Beside],
) -> None:
    assert len(rows) >= 15
    for each in rows.values():
        assert each.source
        assert each.verdict in validate.FIGURES
        assert each.verdict == "agree" or each.why, each.quantity


def test_springs_are_no_rubber_and_say_so(rows: dict[str, Beside]) -> None:
    springs = rows["ζ of F = C d^ζ, 1 to 7 mm: springs"]
    assert (springs.ours, springs.verdict) == ("2.00", "disagree")
    crossing = (4.0 / (3.0 * 0.75 * np.pi)) ** 2 * 20.0
    hertz = rows["depth at which springs press as Hertz's half-space of ν ½ does"]
    assert hertz.ours == f"{crossing:.1f} mm"
    assert hertz.verdict == "agree"


@pytest.mark.parametrize(
    ("ours", "verdict"), [(1.456, "agree"), (1.88, "agree"), (1.454, "disagree"), (2.0, "disagree")]
)
def test_a_figure_agrees_within_the_published_digits(ours: float, verdict: str) -> None:
    assert validate.between("ζ", 1.46, 1.88, "a book", ours).verdict == verdict


def test_the_command_prints_each_row_and_counts(
    rows: dict[str, Beside],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(validate, "comparisons", lambda: iter(rows.values()))
    assert validate.run(argparse.Namespace()) == 0
    printed = capsys.readouterr().out
    assert printed.count("✗") == sum(each.verdict == "disagree" for each in rows.values())
    assert printed.splitlines()[-1].endswith("unknown")
