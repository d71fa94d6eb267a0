"""The fault campaign on the hardware-in-the-loop set-up: each fault many times, each trial seeded.

For each: the safe state and the time to it, the fault's name, goals within their limits on the
servos' wire (by the emulated hand's own record), no crash, no hang, and a hand that grips again. A
trial that went otherwise than expected while other programs held the processors is done again and
counted as disturbed; what must never be is never excused by that.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

import numpy as np

from softfinger.tools.benchmarks.campaigns.faults_cases import CASES
from softfinger.tools.benchmarks.campaigns.faults_clock import STEPS, clock_rig
from softfinger.tools.benchmarks.campaigns.faults_rig import Rig
from softfinger.tools.benchmarks.campaigns.faults_trials import Trial, trial
from softfinger.tools.benchmarks.framework.campaign import Tally, run_trials
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
