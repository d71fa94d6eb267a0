"""The campaign of false measurements through an emulated hand and its daemon, two processes."""

from __future__ import annotations

import pytest

from softfinger.tools.benchmarks import witnesses


@pytest.mark.waits
def test_one_grip_of_an_emulated_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(witnesses, "_GRIP", 100.0)  # s, which a busy machine may take
    monkeypatch.setattr(witnesses, "_LOOK", 1.0)
    (table,) = witnesses.measure_emulated(1, "12 N: honest")
    (row,) = table.rows
    if any(kind in row["events"] for kind in ("late", "realtime", "servos.bus")):
        return  # the machine was too busy again and again, and the row says so
    assert (row["met"], row["missed"], row["named wrongly"]) == (1, "", "")
    assert row["settled"] == pytest.approx(1.0, abs=0.05)
    assert 0.9 < row["peak"] < 1.3
