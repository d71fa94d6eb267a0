"""The tick without serial: the pipeline alone on canned readings, and with the simulated hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zmq

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.loop import Loop
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.tools.benchmarks.canned import can, hold
from softfinger.tools.benchmarks.report import Row, row

_TICKS = 20_000
_SECONDS = 20  # of virtual time
_SUBSCRIBERS: dict[tuple[bytes, ...], str] = {
    (): "nobody subscribed",
    (schema.STATE, schema.TACTILE): "state and frames subscribed",
    (schema.STATE, schema.TACTILE, schema.INPUT): "every tick's input, too",
}


def measure() -> list[Row]:
    """Ticks of a hand that holds an object, in µs."""
    rows = [_virtual_second()]
    for topics, words in _SUBSCRIBERS.items():
        for canned in (True, False):
            plant = "pipeline alone" if canned else "with the simulated hand's physics"
            with _holding(topics) as daemon:
                if canned:
                    can(daemon)
                samples = _run(daemon.loop, daemon)
            aim = 20.0 if canned and len(topics) < 3 else None
            rows.append(row(f"tick, {plant}, {words}", "µs", samples, aim))
    return rows


def _virtual_second() -> Row:
    """The whole daemon on virtual time: physics, rendered frames, estimator, control."""
    with _holding(()) as daemon:
        samples = []
        for _ in range(_SECONDS):
            before = time.perf_counter()
            daemon.loop.advance(1.0)
            samples.append((time.perf_counter() - before) * 1e3)
    return row("one second of the whole daemon on virtual time", "ms", samples, aim=50.0)


@contextmanager
def _holding(topics: tuple[bytes, ...]) -> Iterator[Daemon]:
    """A daemon on virtual time that has grasped the simulated object, and who subscribes."""
    settings = Settings.model_validate(
        {
            "loop": {"clock": "virtual"},
            "stream": {"address": "tcp://127.0.0.1:19872"},
            "commands": {"address": "tcp://127.0.0.1:19873"},
        }
    )
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.SUB)
    with Daemon(settings) as daemon:
        for topic in topics:
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        socket.connect(settings.stream.address)
        hold(daemon)
        yield daemon
    socket.close(linger=0)
    context.term()


def _run(loop: Loop, daemon: Daemon) -> list[float]:
    clock = daemon.clock
    samples = []
    for _ in range(_TICKS):
        clock.sleep_until(clock.now() + loop.period)
        before = time.perf_counter_ns()
        loop.tick(clock.now())
        samples.append((time.perf_counter_ns() - before) * 1e-3)
    if loop.state.mode != "holding":
        raise RuntimeError(f"the hand let go: {loop.state.mode} {loop.state.fault}")
    return samples
