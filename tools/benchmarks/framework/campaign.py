"""Campaigns: cases given as data, seeded trials of each, counts with their 95 % bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from softfinger.daemon.errors import SoftfingerError

_SHOWN = 5  # failures that are listed of each case
_GIVE_UP = 3  # trials in a row whose set-up failed


class RigError(SoftfingerError):
    """The set-up itself does not work: nothing was measured."""


class Judged(Protocol):
    """A trial's outcome."""

    @property
    def failure(self) -> str:
        """What was wrong; empty when nothing was."""

    @property
    def disturbed(self) -> bool:
        """Failed while other programs held the processors: to be done again."""


T = TypeVar("T", bound=Judged)


@dataclass
class Tally(Generic[T]):
    """The trials of one case that count, and the failures among them."""

    trials: list[T] = field(default_factory=list)
    passed: int = 0
    disturbed: int = 0  # trials that were done again
    failures: list[str] = field(default_factory=list)  # the first ones, by their seeds

    @property
    def failed(self) -> bool:
        """Whether any trial failed, or none was made."""
        return self.passed < max(len(self.trials), 1)

    @property
    def failure_bound(self) -> float:
        """95 % upper bound of the share of trials that fail."""
        count = len(self.trials)
        return min(upper_bound(count - self.passed, count), 1.0) if count else 1.0


def run_trials(trials: int, one: Callable[[int], T], broken: Callable[[int, str], T]) -> Tally[T]:
    """``trials`` of ``one(seed)`` that count.

    A disturbed trial is made again with another seed, up to ``trials`` times altogether. A RigError
    becomes ``broken(seed, reason)``; three in a row end the case.
    """
    outcome: Tally[T] = Tally()
    for seed, found in _tried(2 * trials, one, broken):
        if found.disturbed and outcome.disturbed < trials:
            outcome.disturbed += 1
            continue
        outcome.trials.append(found)
        outcome.passed += not found.failure
        if found.failure and len(outcome.failures) < _SHOWN:
            outcome.failures.append(f"seed {seed}, {found.failure}")
        if len(outcome.trials) == trials:
            break
    return outcome


def _tried(
    most: int, one: Callable[[int], T], broken: Callable[[int, str], T]
) -> Iterator[tuple[int, T]]:
    in_a_row = 0
    for seed in range(1, most + 1):
        try:
            found = one(seed)
            in_a_row = 0
        except RigError as error:
            found = broken(seed, f"the set-up failed: {error}")
            in_a_row += 1
        yield seed, found
        if in_a_row == _GIVE_UP:
            return


def upper_bound(count: int, trials: int) -> float:
    """The rate at which ``count`` events or fewer in ``trials`` are 5 % likely.

    Poisson's bound by the χ² quantile in Wilson and Hilferty's form: within 1 % from one event on,
    and −ln 0.05 events for none.
    """
    if count == 0:
        return -math.log(0.05) / trials
    k = count + 1.0
    return k * (1.0 - 1.0 / (9.0 * k) + 1.6449 / (3.0 * math.sqrt(k))) ** 3 / trials
