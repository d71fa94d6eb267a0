"""How late the loop's ticks start after their deadline, beside cyclictest and a plain sleep.

Each subject is a process of its own and runs in turns with the others, so that a slow minute slows
all of them, and gives back what it holds of the system after each turn. Ours is the daemon's own
loop on the simulated hand; the plain one sleeps until each deadline with ``time.sleep`` and does
nothing else; cyclictest, which does nothing else either, is Debian's (package rt-tests).
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
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings

_RATE = 1000.0  # Hz
_ROUNDS = 8
_SECONDS = 2.0  # of each turn
_PRIORITY = 40  # of SCHED_FIFO
_LONGEST = 20_000  # µs that cyclictest's histogram reaches
_SHARES = (50.0, 99.0, 99.9)

Samples = NDArray[np.float64]
Turn = Callable[[float], Samples]


@dataclass(frozen=True)
class WakeUps:
    """One subject: how late it woke [µs], from ``count`` wake-ups."""

    name: str
    p50: float
    p99: float
    p999: float
    max: float
    count: int
    aim: float | None = None  # for p99, where there is one [µs]

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {"unit": "µs"}


def measure(
    rounds: int = _ROUNDS, seconds: float = _SECONDS, priorities: tuple[int, ...] = (0, _PRIORITY)
) -> list[WakeUps]:
    """All subjects in turns, with the usual scheduling (0) and, where allowed, SCHED_FIFO."""
    with contextlib.ExitStack() as stack:
        subjects: dict[str, Turn] = {}
        for priority in priorities if may_hurry() else (0,):
            words = f"SCHED_FIFO {priority}" if priority else "usual scheduling"
            for name, work in (("the daemon's loop", _our_loop), ("plain time.sleep", _plain)):
                subjects[f"{name}, {words}"] = stack.enter_context(_child(work, priority))
            if shutil.which("cyclictest"):
                subjects[f"cyclictest, {words}"] = _cyclictest(priority)
        if not shutil.which("cyclictest"):
            print("cyclictest is not here (apt-get install rt-tests): left out", file=sys.stderr)
        taken: dict[str, list[Samples]] = {name: [] for name in subjects}
        for _ in range(rounds):
            for name, turn in subjects.items():
                taken[name].append(turn(seconds))
    rows = {name: _row(name, np.concatenate(each)) for name, each in taken.items()}
    return [_with_aim(row, rows) for row in rows.values()]


def _row(name: str, late: Samples) -> WakeUps:
    p50, p99, p999 = (1e6 * np.percentile(late, _SHARES)).tolist()
    return WakeUps(name, p50, p99, p999, 1e6 * float(late.max()), len(late))


def _with_aim(row: WakeUps, rows: dict[str, WakeUps]) -> WakeUps:
    """Ours is to wake no later than cyclictest under the same scheduling."""
    name, scheduling = row.name.split(", ")
    beside = rows.get(f"cyclictest, {scheduling}")
    if name != "the daemon's loop" or beside is None:
        return row
    return WakeUps(**(asdict(row) | {"aim": beside.p99}))


def table(rows: list[WakeUps]) -> str:
    """The rows as an aligned table."""
    head = f"{f'wake-up after the deadline at {_RATE:g} Hz, µs':46}"
    lines = [f"{head} {'p50':>8} {'p99':>8} {'p99.9':>8} {'max':>8} {'aim p99':>8} {'n':>7}"]
    for row in rows:
        aim = "" if row.aim is None else f"≤ {row.aim:.1f}"
        lines.append(
            f"{row.name:46} {row.p50:8.1f} {row.p99:8.1f} {row.p999:8.1f} {row.max:8.1f} "
            f"{aim:>8} {row.count:7d}"
        )
    return "\n".join(lines)


def may_hurry() -> bool:
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
    """A process that answers seconds with the lateness of its wake-ups in them."""
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


def _asked(link: Connection) -> Iterator[float]:
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
        for seconds in _asked(link):
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
    for seconds in _asked(link):
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
    """It counts whole microseconds, rounded down; the middle of each stands for it."""

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
    """The samples [s] that a report of cyclictest stands for."""
    values, counts = [], []
    for line in text.splitlines():
        if found := re.fullmatch(r"(\d{6})\s+(\d+)\s*", line):
            values.append((int(found[1]) + 0.5) * 1e-6)
            counts.append(int(found[2]))
    beyond = re.search(r"^# Histogram Overflows: *(\d+)", text, re.MULTILINE)
    longest = re.search(r"^# Max Latencies: *(\d+)", text, re.MULTILINE)
    if not values or longest is None:
        raise ValueError("cyclictest said nothing that can be read")
    if beyond is not None and int(beyond[1]):
        values.append(int(longest[1]) * 1e-6)
        counts.append(int(beyond[1]))
    return np.repeat(values, counts)
