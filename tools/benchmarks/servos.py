"""The servos' share of a tick: a read and a write of two servos over a pty, beside the plain SDK.

Paced, the emulated servos take the wire's own time; what is above it is ours and the machine's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator.control_port import send_words
from softfinger.tools.benchmarks.bare_pty import bare
from softfinger.tools.benchmarks.report import Row, row
from softfinger.tools.benchmarks.servo_rig import OurCycle, PlainCycle, emulated

_ROUNDS = 100
_CYCLES = 20  # of each in a round
_PACED = 1500
_RATES = (1_000_000, 2_000_000, 3_000_000, 4_000_000)
_MISSES = 50


def measure() -> list[Row]:
    """Wall and processor time a cycle in µs, and what a missing reply costs in ms.

    With the real-time measures that the daemon takes by default.
    """
    with RealTime(Settings()):
        rows = _unpaced()
        for baud in _RATES:
            rows += _paced(baud)
        return rows + _missing()


def _unpaced() -> list[Row]:
    """Ours, a bare pseudo-terminal's and the plain SDK's in turns, each on a far end of its own."""
    with ExitStack() as stack:
        ours = OurCycle(stack.enter_context(emulated()).folder)
        stack.callback(ours.close)
        floor = stack.enter_context(bare(*ours.bytes().parts))
        plain = PlainCycle(stack.enter_context(emulated()).folder)
        stack.callback(plain.close)
        turns: list[tuple[str, Callable[[], None]]] = [
            ("ours", ours),
            ("bare", floor),
            ("plain", plain),
        ]
        wall: dict[str, list[float]] = {name: [] for name, _ in turns}
        busy: dict[str, list[float]] = {name: [] for name, _ in turns}
        for name, cycle in turns * _ROUNDS:
            spent, cpu = timed(cycle, _CYCLES)
            wall[name] += spent
            busy[name].append(cpu)
        _must_have_worked(ours.failed + plain.failed, 2 * _ROUNDS * _CYCLES)
    return [
        row("read + write of two servos, unpaced pty", "µs", wall["ours"], aim=120.0),
        row("  its processor time", "µs", busy["ours"], aim=100.0),
        row("  the same bytes with no work at either end, in turns with it", "µs", wall["bare"]),
        row("  and their processor time", "µs", busy["bare"]),
        row("  the plain SDK's cycle, in turns with it", "µs", wall["plain"]),
        row("  and its processor time", "µs", busy["plain"]),
    ]


def _must_have_worked(failed: int, count: int) -> None:
    """A machine that is busy elsewhere may hold a reply up past its deadline, now and then."""
    if failed > 0.02 * count:
        raise RuntimeError(f"{failed} of {count} cycles failed")


def timed(cycle: Callable[[], None], count: int) -> tuple[list[float], float]:
    """Wall time of each of ``count`` cycles and the mean processor time of one, in µs."""
    wall = []
    cpu = time.thread_time_ns()
    for _ in range(count):
        before = time.perf_counter_ns()
        cycle()
        wall.append((time.perf_counter_ns() - before) * 1e-3)
    return wall, (time.thread_time_ns() - cpu) * 1e-3 / count


def _paced(baud: int) -> list[Row]:
    with emulated(baud) as stand:
        cycle = OurCycle(stand.folder, baud)
        try:
            traffic = cycle.bytes()
            timed(cycle, 50)
            wire = traffic.seconds(baud) * 1e6  # the servos' return delay is 0
            # From start to start: the bytes of a write are still on the wire when it returns.
            spent, cpu = timed(cycle, _PACED)
            _must_have_worked(cycle.failed, _PACED)
        finally:
            cycle.close()
    share = np.array(spent) / wire
    name = f"read + write of two servos at {baud // 1_000_000} Mbaud"
    return [
        row(f"{name}, {wire:.0f} µs on the wire", "µs", spent),
        row("  over the bytes' own time", "", share, aim=1.15),
        row("  its processor time", "µs", [cpu], aim=200.0),
    ]


def _missing() -> list[Row]:
    with emulated() as stand:
        cycle = OurCycle(stand.folder, strict=True)
        try:
            send_words(stand.folder, "silent=2")
            spent, _ = timed(cycle, _MISSES)
            deadline = cycle.deadline * 1e3
            missed = cycle.failed
            send_words(stand.folder, "answer=2")
        finally:
            cycle.close()
    if missed < _MISSES - 1:
        raise RuntimeError(f"only {missed} of {_MISSES} replies were missing")
    extra = np.array(spent[-missed:]) * 1e-3 - deadline
    return [row(f"a missing reply: cycle's time over its deadline of {deadline:g} ms", "ms", extra)]
