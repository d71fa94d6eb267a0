"""``softfinger bench recording``, shortened: each of its figures is measured."""

from __future__ import annotations

import math

import pytest

from softfinger.tools.benchmarks import recording


def test_a_short_measurement_has_every_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, shorter in (("_READERS", 1), ("_FRAMES", 200), ("_SHORTER", 0.2)):
        monkeypatch.setattr(recording, name, shorter)
    rows = {row.name: row for row in recording.measure(seconds=0.5, hour=1.0)}
    assert rows["messages recorded a second"].median > 0.0
    assert rows["messages lost by the recorder"].count > 100
    assert rows["1 s of states at 1 kHz, opened"].count == 1000
    assert not any(math.isnan(row.median) for row in rows.values())
