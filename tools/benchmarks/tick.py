"""The tick: back to back, in place; and how late it wakes up, beside cyclictest.

Back to back the pipeline's ticks follow each other; in place each wakes from the sleep before it,
as in a running daemon. Both take turns, on canned readings and the same hand.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import RealClock
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.wire import schema
from softfinger.tools.benchmarks.measuring import Report, Row, figure, timed
from softfinger.tools.benchmarks.rigs import can, hold, must_hold, virtual_daemon

Samples = NDArray[np.float64]

_PRIORITY = 40  # of SCHED_FIFO
_LONGEST = 20_000  # µs that cyclictest's histogram reaches


def measure(brief: bool = False) -> list[Report]:
    """Ticks of a hand that holds an object [µs], a second on virtual time [ms], wake-ups [µs]."""
    rows = _in_turns(10 if brief else 40)
    with virtual_daemon({}) as daemon:
        hold(daemon)
        whole = timed(partial(daemon.loop.advance, 1.0), 3 if brief else 20)
        row = figure("with the simulated hand", "µs", ticks(daemon, 2_000 if brief else 20_000))
        plant = SimulatedHand(daemon.settings)
        alone = [timed(partial(plant.advance, 1.0 + k))[0] for k in range(len(whole) + 1)][1:]
    second = [
        figure("the whole daemon", "ms", 1e-3 * np.array(whole), 50.0),
        figure("the plant alone", "ms", 1e-3 * np.array(alone), 5.0),
    ]
    rows.append(row)
    return [
        Report("tick", rows, page=("",)),
        Report("a second on virtual time", second, page=("",)),
        wake_ups(*(3, 0.5) if brief else (8, 2.0)),
    ]


def _in_turns(rounds: int, rates: tuple[float, ...] = (100.0, 500.0, 1000.0)) -> list[Row]:
    """The pipeline alone: back to back with and without subscribers, in place at ``rates``.

    In place also with the rehearsal before each tick. SCHED_FIFO and one processor where allowed.
    """
    samples: dict[str, list[float]] = {}
    used: dict[str, float] = {}  # s of the processor, of all seconds
    topics = (schema.STATE, schema.TACTILE)
    with virtual_daemon({}) as quiet, virtual_daemon({}, *topics) as heard:
        for daemon in (quiet, heard):
            hold(daemon)
            can(daemon)
        quiet.rehearse(Settings().realtime.rehearsal)
        rehearse = quiet.loop.rehearsal
        turns: dict[str, Callable[[], list[float]]] = {
            "back to back": partial(ticks, quiet, 200),
            "back to back, state and frames subscribed": partial(ticks, heard, 200),
        }
        for rate in rates:
            name = f"in place at {rate:g} Hz"
            turns[name] = partial(in_place, quiet, rate)
            turns[f"{name}, rehearsed"] = partial(in_place, quiet, rate, before=rehearse)
        with RealTime(_own_processor()):
            for _ in range(rounds):
                for name, turn in turns.items():
                    began, before = time.perf_counter(), time.thread_time()
                    samples.setdefault(name, []).extend(turn())
                    share = (time.thread_time() - before) / (time.perf_counter() - began)
                    used[name] = used.get(name, 0.0) + share / rounds
        must_hold(quiet)
        must_hold(heard)
    rows = [
        figure(name, "µs", found, None if "place" in name else 20.0)
        for name, found in samples.items()
    ]
    base = rows[0]["median"]
    for row in rows:
        row["× back to back"] = row["median"] / base
        if "place" in row["name"]:
            row["of a processor"] = used[row["name"]]
    return rows


def _own_processor() -> Settings:
    """SCHED_FIFO on one processor where that is allowed; without either where it is not."""
    if not may_be_real_time():
        return Settings()
    cpus = (max(os.sched_getaffinity(0)),)
    return Settings.model_validate({"realtime": {"priority": _PRIORITY, "cpus": cpus}})


def ticks(daemon: Daemon, count: int) -> list[float]:
    """Times of so many ticks on virtual time, one after the other [µs]."""
    loop, clock = daemon.loop, daemon.clock
    samples = []
    for _ in range(count):
        clock.sleep_until(clock.now() + loop.period)
        samples += timed(lambda: loop.tick(clock.now()))
    return samples


def in_place(
    daemon: Daemon, rate: float, count: int = 0, before: Callable[[float], None] | None = None
) -> list[float]:
    """Times of ticks [µs] that each wake at a deadline of the machine's time; of 0.15 s.

    ``before`` is called before each sleep with its end.
    """
    machine = RealClock(daemon.settings.realtime.spin)
    deadline, samples = machine.now(), []
    for _ in range(count or round(0.15 * rate)):
        deadline += 1.0 / rate
        if before is not None:
            before(deadline)
        machine.sleep_until(deadline)
        samples += ticks(daemon, 1)
    return samples


# Wake-ups


def wake_ups(rounds: int, seconds: float, rate: float = 1000.0) -> Report:
    """How late after their deadlines: the daemon's loop, a plain sleep, cyclictest, in turns."""
    turns: dict[str, Callable[[], Samples]] = {"time.sleep": partial(_plain, seconds, rate)}
    late: dict[str, list[Samples]] = {}
    daemons = []
    try:
        for priority in (0, _PRIORITY) if may_be_real_time() else (0,):
            words = f", SCHED_FIFO {priority}" if priority else ""
            sections = {"loop": {"rate": rate}, "realtime": {"priority": priority}}
            daemons.append(Daemon(Settings.model_validate(sections), wire=False))
            turns[f"the daemon's loop{words}"] = partial(_our_loop, daemons[-1], seconds)
            if shutil.which("cyclictest"):
                turns[f"cyclictest{words}"] = partial(_cyclictest, seconds, rate, priority)
        for _ in range(rounds):
            for name, turn in turns.items():
                late.setdefault(name, []).append(turn())
    finally:
        for daemon in daemons:
            daemon.close()
    if not shutil.which("cyclictest"):
        print("bench tick: no cyclictest here (apt-get install rt-tests)", file=sys.stderr)
    rows = []
    for name, found in late.items():
        all_of_them = 1e6 * np.concatenate(found)
        tail = {"p99.9": float(np.percentile(all_of_them, 99.9)), "max": float(all_of_them.max())}
        rows.append(figure(name, "µs", all_of_them, **tail))
    return Report(f"wake-up late at {rate:g} Hz", rows, page=("",))


def may_be_real_time() -> bool:
    """Whether SCHED_FIFO is allowed here."""
    settings = Settings.model_validate({"realtime": {"priority": _PRIORITY}})
    with RealTime(settings) as measures:
        return any(each.granted and "FIFO" in each.text for each in measures.outcomes)


def _our_loop(daemon: Daemon, seconds: float) -> Samples:
    loop, late = daemon.loop, []
    tick = loop.tick

    def kept(now: float) -> float:
        late.append(loop.state.timing.wake_late_s)
        return tick(now)

    with RealTime(daemon.settings):
        loop.advance(0.1)  # after the others' turn the simulated hand is behind
        loop.tick = kept  # type: ignore[method-assign]
        loop.advance(seconds)
        loop.tick = tick  # type: ignore[method-assign]
    return np.array(late)


def _plain(seconds: float, rate: float) -> Samples:
    late, deadline = [], time.monotonic()
    for _ in range(round(seconds * rate)):
        time.sleep(max(deadline - time.monotonic(), 0.0))
        now = time.monotonic()
        late.append(now - deadline)
        deadline = max(deadline + 1.0 / rate, now)
    return np.array(late)


def _cyclictest(seconds: float, rate: float, priority: int) -> Samples:
    words = ["--interval", f"{1e6 / rate:.0f}", "--loops", f"{seconds * rate:.0f}"]
    words += ["--priority", str(priority)] if priority else []
    done = subprocess.run(
        ["cyclictest", "--quiet", "--mlockall", "--histogram", str(_LONGEST), *words],
        capture_output=True,
        text=True,
        check=True,
    )
    return histogram(done.stdout)


def histogram(text: str) -> Samples:
    """The samples [s] of a report of cyclictest, which counts whole µs, rounded down.

    Each counts as its middle; those beyond the histogram all count as the largest.
    """
    found = re.findall(r"^(\d{6})\s+(\d+)\s*$", text, re.MULTILINE)
    longest = re.search(r"^# Max Latencies: *(\d+)", text, re.MULTILINE)
    beyond = re.search(r"^# Histogram Overflows: *(\d+)", text, re.MULTILINE)
    if not found or longest is None:
        raise ValueError("cyclictest printed nothing that can be read")
    values = [1e-6 * (int(value) + 0.5) for value, _ in found] + [1e-6 * int(longest[1])]
    counts = [int(count) for _, count in found] + [int(beyond[1]) if beyond else 0]
    return np.repeat(values, counts)
