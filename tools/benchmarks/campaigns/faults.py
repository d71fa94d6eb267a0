"""The fault campaign on the hardware-in-the-loop set-up: each fault many times, each trial seeded.

For each: the safe state and the time to it, the fault's name, goals within their limits on the
servos' wire (by the emulated hand's own record), no crash, no hang, and a hand that grips again. A
trial that went otherwise than expected while other programs held the processors is done again and
counted as disturbed; what must never be is never excused by that.
"""

from __future__ import annotations

import contextlib
import math
import random
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from unittest import mock

import numpy as np

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.loop import Loop
from softfinger.tools.benchmarks.campaigns.faults_cases import CASES
from softfinger.tools.benchmarks.campaigns.faults_rig import Rig, stopped
from softfinger.tools.benchmarks.campaigns.faults_trials import Trial, judge_wire, trial
from softfinger.tools.benchmarks.framework.campaign import RigError, Tally, run_trials
from softfinger.tools.benchmarks.framework.report import Report, Row

_TRIALS = 100


def measure(trials: int | None = None, only: str = "") -> list[Report]:
    """Every fault, or those whose name the pattern ``only`` is found in."""
    rows, notes, failed = [], [], False
    with ExitStack() as stack:
        for name, expected, allowed, one in _chosen(only, stack):
            outcome = run_trials(trials or _TRIALS, one, broken)
            row = summary(name, expected, allowed, outcome)
            print(f"{name}: {row['passed']} of {row['trials']}", file=sys.stderr, flush=True)
            rows.append(row)
            notes += [f"  {name}, {failure}" for failure in outcome.failures]
            failed = failed or outcome.failed
    return [Report("fault", rows, notes=tuple(notes), failed=failed)]


def known(only: str) -> bool:
    """Whether this pattern is found in any fault's name."""
    try:
        return any(re.search(only, name) for name in (*STEPS, *(case.name for case in CASES)))
    except re.error:
        return False


Chosen = tuple[str, str, float | None, Callable[[int], Trial]]


def _chosen(only: str, stack: ExitStack) -> Iterator[Chosen]:
    """Name, what is expected, time allowed until no motor is driven [s], and how to try it."""
    cases = [case for case in CASES if re.search(only, case.name)]
    if cases:
        rig = stack.enter_context(Rig())
        for case in cases:
            allowed = case.within if case.expect in ("fault", "dies", "stops") else None
            yield case.name, case.expect, allowed, partial(trial, rig, case)
        stack.close()
    steps = [name for name in STEPS if re.search(only, name)]
    if steps:
        clock = stack.enter_context(clock_rig())
        for name in steps:
            yield name, "works", None, partial(clock, name)


def broken(seed: int, reason: str) -> Trial:
    """The trial whose set-up failed."""
    return Trial(seed, wrong=reason)


def summary(name: str, expected: str, allowed: float | None, outcome: Tally[Trial]) -> Row:
    """Counts, and times [ms] of those trials that have them: median and greatest."""
    row: Row = {
        "name": name,
        "expected": expected,
        "passed": outcome.passed,
        "trials": len(outcome.trials),
        "failures, 95 % below": outcome.failure_bound,
        "disturbed": outcome.disturbed,
    }
    for key, times in (
        ("fault ms", [each.fault_s for each in outcome.trials]),
        ("motors off ms", [each.safe_s for each in outcome.trials]),
    ):
        seen = 1e3 * np.array([time for time in times if np.isfinite(time)])
        row[key] = float(np.median(seen)) if seen.size else None
        row[f"{key} at most"] = float(seen.max()) if seen.size else None
    row["allowed ms"] = None if allowed is None else 1e3 * allowed
    counts = Counter(each.fault for each in outcome.trials if each.fault)
    row["faults"] = ", ".join(f"{fault} {count}" for fault, count in counts.items())
    return row


STEPS = {"clock stepped by +1 h": 3600.0, "clock stepped by -1 h": -3600.0}
_BEFORE = 0.04  # s, at most
_AFTER = 0.2  # s
_READY_WITHIN = 15.0  # s
_NEXT = {"fault": "clear", "disarmed": "arm", "armed": "grasp"}
_NEAR = 0.1  # s


@contextlib.contextmanager
def clock_rig() -> Iterator[Callable[[str, int], Trial]]:
    """A trial of a named step by its seed. It raises RigError when the hand does not grip."""
    true, offset = time.time, 0.0

    def wall() -> float:
        return true() + offset

    def trial(name: str, seed: int) -> Trial:
        nonlocal offset
        chance = random.Random(f"{name} {seed}")
        found = Trial(seed, "holding")
        _hold(loop)
        loop.advance(chance.uniform(0.0, _BEFORE))
        rig.waited()
        rig.report("forget")
        begin, seq = time.monotonic(), loop.state.seq
        offset += STEPS[name]
        loop.advance(_AFTER)
        passed = time.monotonic() - begin
        found.waited_s = rig.waited()
        judge_wire(rig, found)
        if abs(loop.state.wall - wall()) > _NEAR:
            found.wrong = f"states of {loop.state.wall:.1f} s, the wall clock is at {wall():.1f} s"
        if loop.state.fault:
            found.fault, found.fault_s = loop.state.fault_name, math.nan
            found.missed = f"{loop.state.fault_name}: {loop.state.fault}"
        elif stopped(rig.report()):
            found.missed = "no motor was driven any more"
        elif not 0.5 < (loop.state.seq - seq) * loop.period / passed < 1.1:
            found.missed = f"{loop.state.seq - seq} ticks in {passed:.3f} s"
        return found

    with Rig() as rig:
        rig.start_hand()
        with (
            Daemon(rig.settings) as daemon,
            mock.patch.object(time, "time", wall),
            mock.patch.object(daemon.clock, "wall", wall),
        ):
            loop = daemon.loop
            loop.advance(0.1)
            yield trial
            loop.command({"command": "stop"})
            loop.advance(0.02)


def _hold(loop: Loop) -> None:
    end = time.monotonic() + _READY_WITHIN
    while loop.state.mode != "holding":
        if time.monotonic() > end:
            raise RigError(f"the hand does not grip: {loop.state.mode} {loop.state.fault}")
        name = _NEXT.get(str(loop.state.mode))
        with contextlib.suppress(Refused):
            if name is not None:
                loop.command({"command": name})
        loop.advance(0.02)
