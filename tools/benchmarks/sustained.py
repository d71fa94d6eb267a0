"""A minute of 500 Hz on two servos at 2 Mbaud, paced: which cycles are missed, and through whom."""

from __future__ import annotations

import os
import resource
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.benchmarks.blame import CAUSES, OWN, Cycle, cause
from softfinger.tools.benchmarks.report import Row, row
from softfinger.tools.benchmarks.servo_rig import OurCycle, emulated

_SECONDS = 60.0
_BAUD = 2_000_000
_PERIOD = 0.002  # s
_PRIORITY = 40  # of SCHED_FIFO: below the kernel's own threads at 50
_LONGEST = 80  # bytes of a schedstat line


def measure() -> list[Row]:
    """Cycles that ended after the next one was due, by what held them up.

    Where it is allowed, both processes run under SCHED_FIFO; the rows say so. What is held up then
    is held up by the kernel: a worker of usual priority carries a pseudo-terminal's bytes across.
    """
    with ExitStack() as stack:
        stand = stack.enter_context(emulated(_BAUD))
        cycle = OurCycle(stand.folder, _BAUD, strict=True)
        stack.callback(cycle.close)
        wire = cycle.bytes().seconds(_BAUD)
        measures = stack.enter_context(RealTime(_urgent(cycle.settings)))
        hurried = any("SCHED_FIFO" in each.text for each in measures.outcomes if each.granted)
        if hurried:
            os.sched_setscheduler(stand.process, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        ours = stack.enter_context(Accounts("self"))
        theirs = stack.enter_context(Accounts(str(stand.process)))
        return _run(cycle, wire, ours, theirs, "SCHED_FIFO" if hurried else "usual scheduling")


def _urgent(settings: Settings) -> Settings:
    realtime = settings.realtime.model_copy(update={"priority": _PRIORITY})
    return settings.model_copy(update={"realtime": realtime})


class Accounts:
    """What the kernel counts of a process's first thread, since it was last asked."""

    def __init__(self, process: str) -> None:
        self._descriptor = os.open(f"/proc/{process}/schedstat", os.O_RDONLY)
        self._last = self._read()

    def _read(self) -> tuple[int, int]:
        words = os.pread(self._descriptor, _LONGEST, 0).split()
        return int(words[0]), int(words[1])

    def since(self) -> tuple[float, float]:
        """Computing and put aside [s]."""
        last, self._last = self._last, self._read()
        return (self._last[0] - last[0]) * 1e-9, (self._last[1] - last[1]) * 1e-9

    def __enter__(self) -> Accounts:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)


def _run(
    cycle: OurCycle, wire: float, ours: Accounts, theirs: Accounts, scheduling: str
) -> list[Row]:
    # Numbers in one array: 30,000 objects would give the collector something to look through.
    rows = np.zeros((int(_SECONDS / _PERIOD) + 1, 6))
    missed: list[int] = []
    count = 0
    unanswered = cycle.failed
    stolen, switches = stolen_time(), _switches()
    clock = cycle.clock
    start = deadline = clock.now() + 0.01
    ours.since()
    theirs.since()
    while deadline < start + _SECONDS and count < len(rows):
        clock.sleep_until(deadline)
        now, computed = clock.now(), time.thread_time()
        cycle()
        done, computed = clock.now(), time.thread_time() - computed
        _, aside = ours.since()
        rows[count] = now - deadline, done - now, computed, aside, *theirs.since()
        deadline += _PERIOD
        if done > deadline:
            missed.append(count)
            deadline = clock.now()
        count += 1
    rows = rows[:count]
    late, work, computing, put_aside, servos_computing, servos_put_aside = rows.T
    usual = float(np.median(servos_computing))
    causes = Counter(cause(Cycle(*rows[each]), _PERIOD, wire, usual) for each in missed)
    name = f"500 Hz for {_SECONDS:g} s at 2 Mbaud, {scheduling}: a cycle's work"
    return [
        row(name, "µs", work * 1e6),
        row("  the bytes' own time on the wire", "µs", [wire * 1e6]),
        row("  its processor time", "µs", computing * 1e6, aim=200.0),
        row("  its wake-up after the deadline", "µs", late * 1e6),
        row("  the emulated servos' processor time", "µs", servos_computing * 1e6),
        row(f"  cycles of {count} that ended after the next was due", "", [len(missed)]),
        *(
            row(f"    through {each}", "", [causes[each]], aim=0.0 if each == OWN else None)
            for each in CAUSES
        ),
        row("  replies that did not come in time", "", [cycle.failed - unanswered]),
        row("  the program was put aside for, altogether", "ms", [1e3 * put_aside.sum()]),
        row("  and the emulated servos", "ms", [1e3 * servos_put_aside.sum()]),
        row("  times that the program was put aside", "", [_switches() - switches]),
        row("  time that the host took from this machine", "ms", [1e3 * (stolen_time() - stolen)]),
    ]


def _switches() -> int:
    """How often others took this thread's processor."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def stolen_time() -> float:
    """Seconds, over all processors, that a virtual machine's host gave to others; 0 on metal."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
