"""`bench tick` in short: a hand that holds over ptys, its servos emulated by another process."""

from __future__ import annotations

from softfinger.tools.benchmarks import tick
from tests.harness.daemon_process import PATIENCE


def test_ticks_over_ptys_and_their_exchanges_take_turns() -> None:
    patient = [f"{key}={value}" for key, value in PATIENCE.items()]
    report = tick.in_the_loop(2, 2_000_000, patient)
    assert [row["n"] for row in report.rows] == [40] * 3, report.notes
    assert all(row["median"] > 0.0 for row in report.rows)
