"""The tick without serial: the pipeline alone on canned readings, and with the simulated hand."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.wire import schema
from softfinger.tools.benchmarks.framework.interleaved import timed
from softfinger.tools.benchmarks.framework.report import Report, Row, figure
from softfinger.tools.benchmarks.framework.rigs import can, hold, virtual_daemon

TITLE = "tick, back to back"
PAGE = {TITLE: ("pipeline alone, nobody subscribed", "one second of the whole")}
_SUBSCRIBERS: dict[tuple[bytes, ...], str] = {
    (): "nobody subscribed",
    (schema.STATE, schema.TACTILE): "state and frames subscribed",
    (schema.STATE, schema.TACTILE, schema.INPUT): "every tick's input, too",
}


def measure(brief: bool = False) -> list[Report]:
    """Ticks of a hand that holds an object [µs], and a second on virtual time [ms]."""
    ticks, seconds = (2_000, 3) if brief else (20_000, 20)
    rows: list[Row] = []
    for topics, words in _SUBSCRIBERS.items():
        with virtual_daemon({}, *topics) as daemon:
            hold(daemon)
            if not topics:
                rows += _virtual_seconds(daemon, seconds)
            physics = figure(f"with the simulated hand, {words}", "µs", _ticks(daemon, ticks))
            can(daemon)
            aim = 20.0 if len(topics) < 3 else None
            rows.append(figure(f"pipeline alone, {words}", "µs", _ticks(daemon, ticks), aim))
            rows.append(physics)
    return [Report(TITLE, rows)]


def _virtual_seconds(daemon: Daemon, seconds: int) -> Iterator[Row]:
    """Physics, rendered frames, estimator and control; and the plant alone."""
    whole = [1e-3 * timed(lambda: daemon.loop.advance(1.0), 1)[0] for _ in range(seconds)]
    yield figure("one second of the whole daemon on virtual time", "ms", whole, aim=50.0)
    plant = SimulatedHand(daemon.settings)
    alone = [1e-3 * timed(partial(plant.advance, 1.0 + k), 1)[0] for k in range(seconds)][1:]
    yield figure("one second of the plant alone", "ms", alone, aim=5.0)


def _ticks(daemon: Daemon, count: int) -> list[float]:
    loop, clock = daemon.loop, daemon.clock
    samples = []
    for _ in range(count):
        clock.sleep_until(clock.now() + loop.period)
        samples += timed(lambda: loop.tick(clock.now()), 1)
    if loop.state.mode != "holding":
        raise RuntimeError(f"the hand let go: {loop.state.mode} {loop.state.fault}")
    return samples
