"""Test publication rates, and the quantiles and memory allocation of loop-time histograms."""

import math
import tracemalloc
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import Publishing, every
from softfinger.daemon.loop.timing import QUANTILES, TIMES, Statistics, record
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import State
from softfinger.daemon.wire.publisher import bit
from softfinger.daemon.wire.schema import STATE, STATS, TACTILE, Rates


class Listener:
    """Subscriber to all topics that stores the received tick numbers."""

    wanted = bit(STATE) | bit(TACTILE) | bit(STATS)

    def __init__(self) -> None:
        self.ticks: dict[str, list[int]] = {"state": [], "stats": []}
        self.frames: tuple[list[int], list[int]] = ([], [])  # frame numbers of each finger
        self.rates: list[Rates] = []
        self.seq = 0

    def send(self, topic: bytes, first: Any, *others: Any) -> None:
        if topic == TACTILE:
            _, finger, *_ = others
            self.frames[finger].append(first.seq)
        else:
            self.ticks[topic.decode().removeprefix("hand/")].append(first.seq)
        if topic == STATS:
            self.rates.append(others[1])

    def event(self, *_: Any) -> None: ...


def listened(seconds: float, **sections: Any) -> tuple[Listener, Daemon]:
    settings = Settings.model_validate({"loop": {"clock": "virtual"}, **sections})
    listener = Listener()
    with Daemon(settings, wire=False) as daemon:
        loop = daemon.loop
        sending = Publishing(settings, listener, loop.perception.fingers, loop.statistics)

        def publish(state: State) -> None:
            listener.seq = state.seq
            sending(state)

        loop._publishing = publish
        loop.advance(seconds)
    return listener, daemon


def test_each_topic_is_published_on_every_nth_tick_or_frame():
    listener, _ = listened(4.0, stream={"tactile_rate": 25.0})
    ticks = listener.ticks
    assert ticks["state"] == list(range(5, 2001, 5))
    assert ticks["stats"] == [3, 503, 1003, 1503]
    assert not set(ticks["state"]) & set(ticks["stats"])
    # Frames arrive at 100 Hz, and the publisher sends every fourth frame.
    for frames in listener.frames:
        assert [seq // 4 for seq in frames] == list(range(len(frames)))
        assert len(frames) == pytest.approx(100, abs=1)


def test_rates_are_measured_over_the_last_second():
    stream = {"state_rate": 50.0, "tactile_rate": 20.0}
    listener, _ = listened(4.0, tactile={"rate": 80.0}, stream=stream)
    # The first message has no earlier count.
    assert math.isnan(listener.rates[0].tick)
    rates = listener.rates[-1]
    assert rates.tick == pytest.approx(500.0, abs=0.5)
    assert rates.left == pytest.approx(80.0, abs=1.01)
    assert rates.right == pytest.approx(80.0, abs=1.01)
    assert rates.state == pytest.approx(50.0, abs=0.1)
    assert rates.tactile == pytest.approx(40.0, abs=2.01)  # The frame rate is 20 Hz per finger.


@pytest.mark.parametrize(
    ("rate", "wanted", "ticks"), [(500.0, 100.0, 5), (1000.0, 100.0, 10), (500.0, 300.0, 2),
                                  (100.0, 400.0, 1), (10.0, 0.1, 100)]
)  # fmt: skip
def test_a_rate_is_rounded_to_whole_numbers_of_ticks(rate, wanted, ticks):
    assert every(rate, wanted) == ticks


def fed(rows: np.ndarray) -> Statistics:
    statistics = Statistics()
    for wake, compute, bus, publish in rows.tolist():
        record(statistics.counts, statistics.largest, (wake, compute, bus, publish))
    return statistics


@pytest.mark.parametrize("count", [1, 7, 1000, 20_000])
def test_quantiles_match_the_samples_within_one_bin(count):
    generator = np.random.default_rng(count)
    rows = 10.0 ** generator.uniform(-8.5, 1.5, (count, 4)) * [1.0, 1e-1, 1e-2, 1e-3]
    spreads = fed(rows).spreads()
    for j, name in enumerate(TIMES):
        for share, told in zip(QUANTILES, spreads[name], strict=False):
            true = np.quantile(rows[:, j], share, method="inverted_cdf")
            if true < 2.0**-30:  # One bin holds all times below 1 ns.
                assert told <= 2.0**-29, (name, share)
            else:
                assert true * (1 - 1e-12) <= told <= true * (1 + 1 / 31), (name, share)
        assert spreads[name].max == rows[:, j].max()


def test_times_beyond_the_scale_are_counted():
    statistics = fed(np.array([[0.0, -1.0, 1e-12, 1e9], [math.nan, 1e9, 0.0, 1e9]]))
    assert statistics.ticks == 2
    assert statistics.counts.sum() == 8
    spreads = statistics.spreads()
    assert spreads["publish"] == (1e9, 1e9, 1e9, 1e9)
    assert spreads["compute"].p50 == pytest.approx(0.0, abs=2e-9)


def test_an_empty_histogram_is_all_zero():
    statistics = Statistics()
    assert statistics.ticks == 0
    assert all(spread == (0.0, 0.0, 0.0, 0.0) for spread in statistics.spreads().values())


def test_histograms_allocate_nothing():
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
