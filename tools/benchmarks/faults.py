"""The fault campaign on the hardware-in-the-loop set-up: each fault many times, each trial seeded.

For each: the safe state and the time to it, the fault's name, goals within their limits on the
servos' wire (by the stand-in hand's own record), no crash, no hang, and a hand that grips again. A
trial that went otherwise than expected while other programs held the processors is done again and
counted as disturbed; what must never be is never excused by that.
"""

from __future__ import annotations

import contextlib
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from softfinger.tools.benchmarks.faults_cases import CASES, Case
from softfinger.tools.benchmarks.faults_clock import STEPS, clock_rig
from softfinger.tools.benchmarks.faults_rig import Rig, RigError
from softfinger.tools.benchmarks.faults_trials import Trial, trial

OPTIONS = ("trials", "only")
_TELL = 5  # failures that are told of each fault
_GIVE_UP = 3  # set-ups in a row that did not work


@dataclass
class Outcome:
    """All trials of one fault. Times in s, None where there is none."""

    name: str
    expected: str
    allowed_s: float | None = None  # until no motor is driven
    trials: int = 0  # that count
    passed: int = 0
    disturbed: int = 0  # besides those
    faults: dict[str, int] = field(default_factory=dict)  # that latched, by name
    fault_s: list[float] | None = None  # until it was told: median, greatest
    safe_s: list[float] | None = None  # until no motor was driven: likewise
    seconds: float = 0.0  # for all of them
    failures: list[str] = field(default_factory=list)  # seed and what was wrong, the first ones

    @property
    def failed(self) -> bool:
        """Whether any trial went wrong, or none was made."""
        return self.passed < self.trials or self.trials == 0

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def measure(trials: int = 100, only: str = "") -> list[Outcome]:
    """Every fault, or those whose name the pattern ``only`` is found in; told as they are done."""
    outcomes: list[Outcome] = []
    chosen = [case for case in CASES if re.search(only, case.name)]
    if chosen:
        with Rig() as rig:
            outcomes += [_told(_of_case(rig, case, trials)) for case in chosen]
    steps = [name for name in STEPS if re.search(only, name)]
    if steps:
        with clock_rig() as clock:
            for name in steps:
                outcome = Outcome(name, "works")
                outcomes.append(_told(_all(outcome, trials, partial(clock.trial, name))))
    return outcomes


def known(only: str) -> bool:
    """Whether this pattern is found in any fault's name."""
    try:
        return any(re.search(only, name) for name in (*STEPS, *(case.name for case in CASES)))
    except re.error:
        return False


def _of_case(rig: Rig, case: Case, trials: int) -> Outcome:
    allowed = case.within if case.expect in ("fault", "dies", "stops") else None
    outcome = Outcome(case.name, case.expect, allowed)
    return _all(outcome, trials, lambda seed: trial(rig, case, seed))


def _all(outcome: Outcome, trials: int, one: Callable[[int], Trial]) -> Outcome:
    begin = time.monotonic()
    done = list(_counted(outcome, trials, one))
    outcome.seconds = round(time.monotonic() - begin, 1)
    outcome.faults = dict(Counter(each.fault for each in done if each.fault))
    outcome.fault_s = _spread([each.fault_s for each in done])
    outcome.safe_s = _spread([each.safe_s for each in done])
    return outcome


def _counted(outcome: Outcome, trials: int, one: Callable[[int], Trial]) -> Iterator[Trial]:
    """Trials that count; disturbed ones are made again with another seed, up to as many."""
    broken = 0
    for seed in range(1, 2 * trials + 1):
        if outcome.trials == trials:
            return
        try:
            found = one(seed)
            broken = 0
        except RigError as error:
            broken += 1
            found = Trial(seed, wrong=f"the set-up failed: {error}")
        if found.disturbed and outcome.disturbed < trials:
            outcome.disturbed += 1
            continue
        outcome.trials += 1
        outcome.passed += found.ok
        if not found.ok and len(outcome.failures) < _TELL:
            outcome.failures.append(f"seed {seed}, {found.phase}: {found.wrong or found.missed}")
        yield found
        if broken == _GIVE_UP:
            return


def _spread(values: list[float]) -> list[float] | None:
    there = np.array(values, np.float64)
    there = there[np.isfinite(there)]
    if not there.size:
        return None
    return [round(float(np.median(there)), 4), round(float(there.max()), 4)]


def _told(outcome: Outcome) -> Outcome:
    with contextlib.suppress(OSError):
        print(_line(outcome), *outcome.failures, sep="\n    ", file=sys.stderr, flush=True)
    return outcome


_HEAD = (
    f"{'':34} {'expected':9} {'passed':>9} {'dist.':>5}  "
    f"{'fault told, ms':>15}  {'motors off, ms':>15} {'allowed':>7}  faults"
)


def table(outcomes: list[Outcome]) -> str:
    """The outcomes as an aligned table: medians / greatest times."""
    lines = [_HEAD]
    for each in outcomes:
        lines += [_line(each), *(f"    {text}" for text in each.failures)]
    total = sum(each.trials for each in outcomes)
    passed = sum(each.passed for each in outcomes)
    lines.append(f"{passed} of {total} trials as they must be, in {_minutes(outcomes):.1f} min")
    return "\n".join(lines)


def _minutes(outcomes: list[Outcome]) -> float:
    return sum(each.seconds for each in outcomes) / 60.0


def _line(each: Outcome) -> str:
    faults = ", ".join(f"{name} {count}" for name, count in each.faults.items())
    allowed = "" if each.allowed_s is None else f"{1e3 * each.allowed_s:.0f}"
    line = (
        f"{each.name:34} {each.expected:9} {each.passed:4}/{each.trials:<4} {each.disturbed:5}  "
        f"{_times(each.fault_s):>15}  {_times(each.safe_s):>15} {allowed:>7}  {faults}"
    )
    return line.rstrip()


def _times(spread: list[float] | None) -> str:
    return "" if spread is None else f"{1e3 * spread[0]:.0f} / {1e3 * spread[1]:.0f}"
