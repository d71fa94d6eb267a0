"""What goes out when: exact decimation, rates as they really were, and the statistics' message."""

from __future__ import annotations

from typing import Any

import pytest

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import Publishing, every
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import State
from softfinger.daemon.wire.publisher import bit
from softfinger.daemon.wire.schema import STATE, STATS, TACTILE, Rates


class Listener:
    """Wants everything and keeps the tick numbers of what it got."""

    wanted = bit(STATE) | bit(TACTILE) | bit(STATS)

    def __init__(self) -> None:
        self.ticks: dict[str, list[int]] = {"state": [], "stats": []}
        self.frames: tuple[list[int], list[int]] = ([], [])  # of each finger, by number
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
        sending = Publishing(settings, listener, loop.perception.fingers, loop.statistics)  # type: ignore[arg-type]

        def publish(state: State) -> None:
            listener.seq = state.seq
            sending(state)

        loop._publishing = publish  # type: ignore[assignment]
        loop.advance(seconds)
    return listener, daemon


def test_each_topic_goes_out_on_exactly_every_nth_tick_or_frame() -> None:
    listener, _ = listened(4.0, stream={"tactile_rate": 25.0})
    ticks = listener.ticks
    assert ticks["state"] == list(range(5, 2001, 5))
    assert ticks["stats"] == [3, 503, 1003, 1503]
    assert not set(ticks["state"]) & set(ticks["stats"])
    for frames in listener.frames:  # 100 Hz, of which 25 are published: one of each four
        assert [seq // 4 for seq in frames] == list(range(len(frames)))
        assert len(frames) == pytest.approx(100, abs=1)


def test_rates_are_what_really_happened_in_the_last_second() -> None:
    stream = {"state_rate": 50.0, "tactile_rate": 20.0}
    listener, _ = listened(4.0, tactile={"rate": 80.0}, stream=stream)
    rates = listener.rates[-1]
    assert rates.tick == pytest.approx(500.0, abs=0.5)
    assert rates.left == pytest.approx(80.0, abs=1.01)
    assert rates.right == pytest.approx(80.0, abs=1.01)
    assert rates.state == pytest.approx(50.0, abs=0.1)
    assert rates.tactile == pytest.approx(40.0, abs=2.01)  # 20 of each finger


@pytest.mark.parametrize(
    ("rate", "wanted", "ticks"), [(500.0, 100.0, 5), (1000.0, 100.0, 10), (500.0, 300.0, 2),
                                  (100.0, 400.0, 1), (10.0, 0.1, 100)]
)  # fmt: skip
def test_a_rate_is_the_nearest_whole_number_of_ticks(
    rate: float, wanted: float, ticks: int
) -> None:
    assert every(rate, wanted) == ticks
