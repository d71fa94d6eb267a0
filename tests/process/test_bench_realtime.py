"""The real-time measurements in short: every subject, neighbour, scene and step runs."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from softfinger.tools.benchmarks import neighbours, scenes, wakeup

REPORT = """\
# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000014 000003
000015 000001
# Total: 000000004
# Min Latencies: 00014
# Avg Latencies: 00022
# Max Latencies: 00250
# Histogram Overflows: 00002
"""


def test_a_report_of_cyclictest_is_read_with_what_its_histogram_does_not_reach() -> None:
    assert wakeup.histogram(REPORT).tolist() == pytest.approx(
        [14.5e-6, 14.5e-6, 14.5e-6, 15.5e-6, 250e-6, 250e-6]
    )
    with pytest.raises(ValueError, match="nothing that can be read"):
        wakeup.histogram("usage: cyclictest")


def test_wake_ups_of_every_subject_are_measured() -> None:
    rows = wakeup.measure(rounds=1, seconds=0.1, priorities=(0,))
    names = {row.name.split(", ")[0] for row in rows}
    assert {"the daemon's loop", "plain time.sleep"} <= names
    assert ("cyclictest" in names) == (shutil.which("cyclictest") is not None)
    for row in rows:
        assert row.count > 0
        assert 0.0 <= row.p50 <= row.p99 <= row.p999 <= row.max
    assert len(wakeup.table(rows).splitlines()) == len(rows) + 1


def test_each_scene_ticks_and_each_step_can_be_switched_off() -> None:
    rows = scenes.measure(rounds=1)
    costs = [row for row in rows if isinstance(row, scenes.Cost)]
    savings = [row for row in rows if isinstance(row, scenes.Saving)]
    assert [row.name for row in costs] == list(scenes.SCENES)
    assert [row.name for row in savings][:-1] == list(scenes.STEPS)
    assert all(row.median > 0.0 for row in costs)
    told = scenes.table(rows)
    assert all(row.name in told for row in rows)


def test_a_saving_is_told_from_chance() -> None:
    generator = np.random.default_rng(2)
    noise = generator.normal(0.0, 1.0, (3, 400))
    nothing = scenes._saving("none", 10.0 + noise[0], 10.0 + noise[1])
    one = scenes._saving("some", 10.0 + noise[0], 11.0 + noise[2])
    assert not nothing.measurable
    assert one.measurable
    assert one.saved == pytest.approx(1.0, abs=0.3)
    assert one.error == pytest.approx(1.2533 * np.sqrt(2.0 / 400), rel=0.3)


def test_a_subscriber_that_never_reads_takes_no_more_memory_than_its_queue() -> None:
    kept = neighbours.stuck_subscriber(fill=3000, more=10_000)
    assert kept.later <= kept.bound
