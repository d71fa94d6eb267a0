"""How late the loop's ticks start after their deadline, beside cyclictest and a plain sleep.

Each subject is a process of its own and runs in turns with the others. Ours is the daemon's own
loop on the simulated hand; the plain one sleeps until each deadline with ``time.sleep`` and does
nothing else, as does cyclictest (Debian's package rt-tests).
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.benchmarks.framework.report import Report, figure

TITLE = "wake-up after the deadline, at 1 kHz"
PAGE = {TITLE: ("",)}
_RATE = 1000.0  # Hz
_PRIORITY = 40  # of SCHED_FIFO
_LONGEST = 20_000  # µs that cyclictest's histogram reaches

Samples = NDArray[np.float64]
Turn = Callable[[float], Samples]


def measure(brief: bool = False) -> list[Report]:
    """All subjects in turns, with the usual scheduling and, where it is allowed, SCHED_FIFO."""
    rounds, seconds = (3, 0.5) if brief else (8, 2.0)
    return [Report(TITLE, _rows(_taken(rounds, seconds)))]


def _taken(rounds: int, seconds: float) -> dict[str, Samples]:
    """Lateness of each subject's wake-ups [µs]."""
    with contextlib.ExitStack() as stack:
        subjects: dict[str, Turn] = {}
        for priority in (0, _PRIORITY) if may_be_real_time() else (0,):
            words = f"SCHED_FIFO {priority}" if priority else "usual scheduling"
            for name, work in (("the daemon's loop", _our_loop), ("plain time.sleep", _plain)):
                subjects[f"{name}, {words}"] = stack.enter_context(_child(work, priority))
            if shutil.which("cyclictest"):
                subjects[f"cyclictest, {words}"] = _cyclictest(priority)
        if not shutil.which("cyclictest"):
            print("cyclictest is not here (apt-get install rt-tests): left out", file=sys.stderr)
        turns = [{name: turn(seconds) for name, turn in subjects.items()} for _ in range(rounds)]
    return {name: 1e6 * np.concatenate([turn[name] for turn in turns]) for name in subjects}


def _rows(taken: dict[str, Samples]) -> list[dict[str, object]]:
    rows = []
    for name, late in taken.items():
        tail = {"p99.9": float(np.percentile(late, 99.9)), "max": float(late.max())}
        rows.append(figure(name, "µs", late) | tail)
    return rows


def may_be_real_time() -> bool:
    """Whether SCHED_FIFO is allowed here."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except OSError:
        return False
    os.sched_setscheduler(0, *before)
    return True


@contextlib.contextmanager
def _child(work: Callable[[Connection, int], None], priority: int) -> Iterator[Turn]:
    """A process that answers seconds with the lateness of its wake-ups in them [s]."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    process = spawn.Process(target=work, args=(there, priority))
    process.start()
    there.close()

    def turn(seconds: float) -> Samples:
        here.send(seconds)
        answer: Samples = here.recv()
        return answer

    try:
        yield turn
    finally:
        here.close()
        process.join()


def _turns(link: Connection) -> Iterator[float]:
    """The seconds of each turn, until the other end is closed."""
    with contextlib.suppress(EOFError):
        while True:
            yield link.recv()


def _our_loop(link: Connection, priority: int) -> None:
    settings = Settings.model_validate(
        {"loop": {"rate": _RATE}, "realtime": {"priority": priority}}
    )
    with Daemon(settings, wire=False) as daemon:
        loop, late = daemon.loop, []
        tick = loop.tick

        def kept(now: float) -> float:
            late.append(loop.state.timing.wake_late_s)
            return tick(now)

        loop.tick = kept  # type: ignore[method-assign]
        for seconds in _turns(link):
            with RealTime(settings):
                # The first ticks after a turn of others find the simulated hand behind.
                loop.advance(0.1)
                late.clear()
                loop.advance(seconds)
            link.send(np.array(late))


def _plain(link: Connection, priority: int) -> None:
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    period = 1.0 / _RATE
    for seconds in _turns(link):
        late = []
        deadline = time.monotonic()
        finish = deadline + seconds
        while deadline < finish:
            time.sleep(max(deadline - time.monotonic(), 0.0))
            now = time.monotonic()
            late.append(now - deadline)
            deadline = max(deadline + period, now)
        link.send(np.array(late))


def _cyclictest(priority: int) -> Turn:
    def turn(seconds: float) -> Samples:
        words = ["--interval", f"{1e6 / _RATE:.0f}", "--loops", f"{seconds * _RATE:.0f}"]
        if priority:
            words += ["--priority", str(priority)]
        done = subprocess.run(
            ["cyclictest", "--quiet", "--mlockall", "--histogram", str(_LONGEST), *words],
            capture_output=True,
            text=True,
            check=True,
        )
        return histogram(done.stdout)

    return turn


def histogram(text: str) -> Samples:
    """The samples [s] of a report of cyclictest, which counts whole µs, rounded down.

    Each counts as its middle; those beyond the histogram all count as the largest.
    """
    values, counts = [], []
    for line in text.splitlines():
        if found := re.fullmatch(r"(\d{6})\s+(\d+)\s*", line):
            values.append((int(found[1]) + 0.5) * 1e-6)
            counts.append(int(found[2]))
    beyond = re.search(r"^# Histogram Overflows: *(\d+)", text, re.MULTILINE)
    longest = re.search(r"^# Max Latencies: *(\d+)", text, re.MULTILINE)
    if not values or longest is None:
        raise ValueError("cyclictest printed nothing that can be read")
    if beyond is not None and int(beyond[1]):
        values.append(int(longest[1]) * 1e-6)
        counts.append(int(beyond[1]))
    return np.repeat(values, counts)
