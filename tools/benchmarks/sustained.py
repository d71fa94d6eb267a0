"""A minute of 500 Hz on two servos at 2 Mbaud, paced: which cycles are missed, and through whom."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from pathlib import Path

from daemon.realtime import settle
from tools.benchmarks.report import Row, row
from tools.benchmarks.servo_rig import OurCycle, emulated, urgent

_SECONDS = 60.0
_BAUD = 2_000_000
_PERIOD = 0.002  # s


def measure() -> list[Row]:
    """Cycles that ended after the next one was due, by what held them up.

    Where it is allowed, both processes run under SCHED_FIFO; the rows say so. What is still held
    up then is the pseudo-terminal: a kernel worker of usual priority carries its bytes across.
    """
    with ExitStack() as stack:
        cycle = OurCycle(stack.enter_context(emulated(_BAUD, hurry=True)), _BAUD)
        stack.callback(cycle.close)
        settle()
        allowed = stack.enter_context(urgent())
        return _run(cycle, "SCHED_FIFO" if allowed else "usual scheduling")


def _run(cycle: OurCycle, scheduling: str) -> list[Row]:
    late, work, busy = [], [], []
    stolen = stolen_time()
    missed = own = unanswered = 0
    start = deadline = time.monotonic() + 0.01
    while deadline < start + _SECONDS:
        time.sleep(max(deadline - time.monotonic(), 0.0))
        failed = cycle.failed
        now, cpu = time.monotonic(), time.thread_time()
        cycle()
        done, spent = time.monotonic(), time.thread_time() - cpu
        late.append((now - deadline) * 1e6)
        work.append((done - now) * 1e6)
        busy.append(spent * 1e6)
        deadline += _PERIOD
        unanswered += cycle.failed - failed
        if done > deadline:
            missed += 1
            # What it computed, and not what it waited for, was too long for the rest of a period.
            own += spent > 0.5 * _PERIOD
            deadline = time.monotonic()
    count = len(work)
    return [
        row(f"500 Hz for {_SECONDS:g} s at 2 Mbaud, {scheduling}: a cycle's work", "µs", work),
        row("  its processor time", "µs", busy, aim=200.0),
        row("  its wake-up after the deadline", "µs", late),
        row(f"  cycles of {count} that ended after the next was due", "", [missed]),
        row("  of them for the program's own computing", "", [own], aim=0.0),
        row("  replies that did not come in time", "", [unanswered]),
        row("  time that the host took from this machine", "ms", [1e3 * (stolen_time() - stolen)]),
    ]


def stolen_time() -> float:
    """Seconds, over all processors, that a virtual machine's host gave to others; 0 on metal."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
