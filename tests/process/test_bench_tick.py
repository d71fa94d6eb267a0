"""`bench tick` in short: a hand that holds over ptys, its servos emulated by another process."""

from __future__ import annotations

from softfinger.tools.benchmarks import tick
from tests.harness.daemon_process import PATIENCE


def test_ticks_over_ptys_and_their_exchanges_take_turns() -> None:
    patient = [f"{key}={value}" for key, value in PATIENCE.items()]
    report = tick.in_the_loop(2, 2_000_000, patient)
    assert [row["n"] for row in report.rows] == [40] * 4, report.notes
    ticks, exchanges, _, over = (row["median"] for row in report.rows)
    assert 0.0 < exchanges < ticks
    assert over > 0.0
