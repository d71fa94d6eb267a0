"""Measure how a grip reacts to a sudden load increase.

In a 10 N grip, a constant load acts on the object along its faces, away from the palm. Then a
larger load is applied and maintained. The larger load is a push, or a twist with the same force at
the faces. Trials run in virtual time, and the results are computed from the simulated hand's true
state. *Lost*: the object is no longer between the tips. *Slid*: displacement of the object along
its faces. The displacement is measured relative to the midpoint between the tips, so leaning
fingers do not affect the result. *Answer*: time from the onset of slip until the goal currents have
increased by a quarter. *Said*: time from object loss until the hand leaves the grip modes.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from statistics import fmean
from typing import Any, NamedTuple

from softfinger.daemon.control.modes import GRIPPING_MODES
from softfinger.tools.benchmarks.measuring import Report, Row, figure
from softfinger.tools.benchmarks.rigs import (
    SENSORS,
    SOLID,
    RigError,
    Sections,
    VirtualGrip,
    merged,
    must_hold,
)

# Three kinds of tips with an ideal sensor, and spring tips with each defective sensor.
TIPS: dict[str, Sections] = {
    "springs": {},
    "bristles": {"simulation": {"tip_law": "bristles"}},
    "solid": SOLID,
    **SENSORS,
}
MASSES = (0.1, 0.5, 2.0)  # kg
STANDING = (0.0, 3.0, 6.0, 8.0, 9.0)  # N
OVERLOADS = (12.5, 13.0, 14.0, 15.0, 16.0, 18.0)  # loads [N]; friction can hold 12 N in a 10 N grip
REDUCED_LOADS = (0.0, 6.0, 9.0), (13.0, 15.0, 18.0)  # loads without `--full` [N]
_FORCE = 10.0  # N
_TRIAL_COUNT = 3  # number of trials per case
_RESPONSE_AIM, _REPORT_AIM = 22.0, 200.0  # ms
_GRIP_TIMEOUT = 5.0  # time limit for reaching the mode `holding` [s]
# Durations of the standing-load ramp, and of the constant standing load that follows [s].
_LOAD_TIME, _STANDING_TIME = 1.0, 1.5
_LOAD_STEP_COUNT = 50  # number of steps in the standing-load ramp
_OBSERVATION_TIME = 1.0  # duration of the overload, and time limit for reporting a loss [s]


class Overload(NamedTuple):
    """Outcome of one trial."""

    answer: float  # response time [s]; NaN if no tip slipped, infinity if the daemon did not react
    slid: float  # maximum displacement while the object was between the tips [m]
    lost: bool
    said: float = math.nan  # time from the loss to its report [s]


def measure(
    brief: bool = False, full: bool = False, sweep: Callable[..., Iterable[Any]] = map
) -> list[Report]:
    """Return one table for each kind of hand and object mass; ``brief`` runs fewer cases.

    ``sweep`` maps cases to outcomes in one or more processes.
    """
    standing, overloads = (STANDING, OVERLOADS) if full else REDUCED_LOADS
    loads = [
        *itertools.product((0.0,), overloads, ("twist",)),
        *itertools.product(standing, overloads, ("push",)),
    ]
    trials = _TRIAL_COUNT
    if brief:
        loads, trials = loads[-1:], 1
    hands = {
        f"{name}, {mass:g} kg": merged({"simulation": {"object_mass": mass}}, tips)
        for (name, tips), mass in itertools.product(TIPS.items(), MASSES)
    }
    seeds = range(1, trials + 1)
    cases = list(itertools.product(hands.values(), loads, seeds))
    outcomes = iter(sweep(_outcome, cases))
    return [_table(name, loads, trials, outcomes) for name in hands]


def _outcome(case: tuple[Sections, tuple[float, float, str], int]) -> Overload | None:
    """Return the outcome of a case, or None if the grip was not established."""
    settings, (standing, overload, kind), seed = case
    try:
        return overloaded(settings, standing, overload, seed, kind)
    except RigError:
        return None


def _table(
    name: str, loads: Sequence[tuple[float, float, str]], trials: int, outcomes: Iterator[Any]
) -> Report:
    rows = []
    for standing, overload, kind in loads:
        tried = [next(outcomes) for _ in range(trials)]
        found = [Overload(*each) for each in tried if each is not None]
        told = row(f"{standing:g} N, then a {kind} of {overload:g} N", found)
        rows.append(told | {"trials": trials, "no grip": trials - len(found)})
    said = [each["reported ms"] for each in rows if each["held %"] < 100.0]
    slowest = max(said, default=0.0)
    note = f"  loss reported within {slowest:.0f} ms, target ≤ {_REPORT_AIM:g}"
    return Report(f"{name}, answer", rows, notes=(note,) if said else ())


def row(name: str, found: Sequence[Overload]) -> Row:
    """Return the percentage of held objects, their maximum displacement, and the reaction times."""
    answers = [1e3 * each.answer for each in found if math.isfinite(each.answer)]
    times: Row = figure(name, "ms", answers, _RESPONSE_AIM) if answers else {"name": name}
    held = [each for each in found if not each.lost]
    return times | {
        "greatest": max(answers, default=math.nan),
        "unanswered": sum(each.answer == math.inf for each in found),
        "held %": 100.0 * len(held) / len(found) if found else math.nan,
        "slid mm": 1e3 * max((each.slid for each in held), default=math.nan),
        "reported ms": 1e3 * max((each.said for each in found if each.lost), default=math.nan),
    }


def overloaded(
    settings: Sections, standing: float, overload: float, seed: int, kind: str = "push"
) -> Overload:
    """Establish a grip, apply the load ``standing`` [N], then ``overload`` [N] as a push or twist.

    Raises RigError if the grip is not established.
    """
    chance = random.Random(seed)
    with VirtualGrip.drawn(seed, chance, settings) as grip:
        loop, state = grip.loop, grip.state
        grip.command("arm")
        loop.advance(0.1)
        grip.command("grasp", force=_FORCE)
        grip.until("holding", _GRIP_TIMEOUT)
        must_hold(state)
        loop.advance(1.0 + chance.uniform(0.0, 0.02))
        grip.pull(standing, _LOAD_TIME, _LOAD_STEP_COUNT)
        loop.advance(_STANDING_TIME)
        begin, slid, gone, said = fmean(grip.along()), 0.0, math.inf, math.inf

        def look() -> None:
            nonlocal slid, gone, said
            if gone == math.inf and grip.between():
                slid = max(slid, abs(fmean(grip.along()) - begin))
            else:
                gone = min(gone, state.t)
            if gone < math.inf and state.mode not in GRIPPING_MODES:
                said = min(said, state.t)

        grip.look = look
        arm = 0.5 * grip.settings.simulation.object_width if kind == "twist" else 1.0
        answer = grip.answer(f"{kind}={arm * overload}", _OBSERVATION_TIME)
        while gone < math.inf and said == math.inf and state.t < gone + _OBSERVATION_TIME:
            loop.advance(loop.period)
        return Overload(answer, slid, gone < math.inf, said - gone if gone < math.inf else math.nan)
