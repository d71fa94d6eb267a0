"""Histograms of the loop's times: against plain NumPy, at no allocation."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from softfinger.daemon.loop.timing import QUANTILES, TIMES, Statistics, record


def fed(rows: np.ndarray) -> Statistics:
    statistics = Statistics()
    for wake, compute, bus, publish in rows.tolist():
        record(statistics.counts, statistics.largest, (wake, compute, bus, publish))
    return statistics


@pytest.mark.parametrize("count", [1, 7, 1000, 20_000])
def test_quantiles_are_those_of_the_samples_within_a_bin(count: int) -> None:
    generator = np.random.default_rng(count)
    rows = 10.0 ** generator.uniform(-8.5, 1.5, (count, 4)) * [1.0, 1e-1, 1e-2, 1e-3]
    spreads = fed(rows).spreads()
    for j, name in enumerate(TIMES):
        for share, told in zip(QUANTILES, spreads[name], strict=False):
            true = np.quantile(rows[:, j], share, method="inverted_cdf")
            if true < 2.0**-30:  # one bin for all that is shorter than a nanosecond
                assert told <= 2.0**-29, (name, share)
            else:
                assert true * (1 - 1e-12) <= told <= true * (1 + 1 / 31), (name, share)
        assert spreads[name].max == rows[:, j].max()


def test_times_off_the_scale_are_counted() -> None:
    statistics = fed(np.array([[0.0, -1.0, 1e-12, 1e9], [math.nan, 1e9, 0.0, 1e9]]))
    assert statistics.ticks == 2
    assert statistics.counts.sum() == 8
    spreads = statistics.spreads()
    assert spreads["publish"] == (1e9, 1e9, 1e9, 1e9)
    assert spreads["compute"].p50 == pytest.approx(0.0, abs=2e-9)


def test_nothing_counted_is_all_zero() -> None:
    statistics = Statistics()
    assert statistics.ticks == 0
    assert all(spread == (0.0, 0.0, 0.0, 0.0) for spread in statistics.spreads().values())


def test_keeping_them_allocates_nothing() -> None:
    statistics = Statistics()
    counts, largest = statistics.counts, statistics.largest
    values = (1e-6, 2e-5, 1e-5, 3e-6)
    record(counts, largest, values)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(1000):
            record(counts, largest, values)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 1000
