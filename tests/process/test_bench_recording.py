"""``softfinger bench recording``, shortened: it measures what it says, and loses nothing."""

from __future__ import annotations

from tools.benchmarks.recording import measure


def test_a_short_measurement_loses_nothing() -> None:
    rows = {row.name: row for row in measure(seconds=1.0, hour=3.0)}
    assert rows["messages lost by the recorder"].median == 0.0
    assert rows["messages recorded a second"].median > 500.0
    assert rows["3 s of states at 1 kHz, opened"].count == 3000
    assert all(row.median == row.median for row in rows.values())  # no NaN
