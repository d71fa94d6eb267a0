"""`bench servos` in short: its cycles work on emulated servos in processes of their own."""

from __future__ import annotations

import pytest

from softfinger.tools.benchmarks import servos


def test_ours_the_plain_sdk_and_bare_bytes_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servos, "must_have_worked", lambda *_: None)  # the machine may be busy
    rows = servos.unpaced(2)
    assert [row["n"] for row in rows] == [40, 2] * 4
    assert all(row["median"] > 0.0 for row in rows)


def test_too_many_failures_are_no_measurement() -> None:
    servos.must_have_worked(2, 100)
    with pytest.raises(RuntimeError, match="3 of 100"):
        servos.must_have_worked(3, 100)
