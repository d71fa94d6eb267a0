"""Measure how grips behave with faulty measurements.

Each case is a grip with a faulty measurement or an unusual tip. A trial's seed determines the
noise, the random delays, the affected finger, the object mass and the torque constant error. Trials
run in virtual time, so the results do not depend on the machine. The results are computed from the
plant's true state.
"""

from __future__ import annotations

import itertools
import math
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

from softfinger.daemon.control.modes import GRIPPING_MODES
from softfinger.daemon.simulation.emulator.emulator import DEFAULT_BOARD
from softfinger.daemon.types import FINGERS
from softfinger.tools.benchmarks.measuring import Report, Row
from softfinger.tools.benchmarks.rigs import SOLID, GripCase, Sections, VirtualGrip, diagnoses

_TRIAL_COUNT = 20
_FORCES = (6.0, 12.0)  # requested forces [N]

# Pass criteria. Forces are relative to the requested force, and times are in seconds.
SETTLES = "settles at 0.8 to 1.2 without a force increase"
BOUNDED = "≤ 50 ms above 1.3, reported within 0.3 s"
_SETTLED_RANGE = (0.8, 1.2)
_EXCESS_TIME_MAX = 0.05  # maximum time with a force above 1.3 times the requested force [s]
_REPORT_TIME_MAX = 0.3  # time limit for a fault report, measured from the middle of the onset [s]
_SLIDE_MAX = 0.010  # m

# Phases of a trial.
_GRIP_TIMEOUT = 2.5  # time limit for reaching the mode `holding` [s]
_REST_TIME = 1.2  # time for which the object is held without a disturbance [s]
_OBSERVATION_TIME = 5.0  # observation time after the fault [s]
_REPEATED_LAG = 1.0  # time from the fault to the second force request [s]

_SENSORS = ("left_sensor", "right_sensor")
# The full scale is 127.5 kPa on real tactile boards, and 262 kPa by default in the simulated
# sensor.
EIGHT_BITS: Sections = {"tactile": {**DEFAULT_BOARD, "backend": "simulated"}}


def _cases(force: float) -> Iterator[GripCase]:
    """Yield the cases; ``{side}`` is a placeholder for the affected finger."""
    settles = partial(GripCase, aim=SETTLES, force=force)
    bounded = partial(GripCase, aim=BOUNDED, force=force)
    yield settles("no fault")
    for who, side, false in (
        ("one sensor", "{side}:", ("{side}_sensor",)),
        ("both sensors", "", _SENSORS),
    ):
        for gain in (0.5, 0.7, 0.85, 1.3, 1.6):
            lies, words = partial(settles, false=false), f"{side}gain={gain}"
            yield lies(f"{who}, gain {gain:g} from the start", words=words, before=True)
            yield lies(f"{who}, gain {gain:g} in 2 s", words=f"{words}@0..2")
            yield lies(f"{who}, gain {gain:g} at once", words=words)
        lies = partial(bounded, false=false)
        for drift in (0.2, -0.2):
            words = f"{side}drift={drift}@0..2"
            name = f"{who}, zero {drift:+.0%} of full scale in 2 s"
            yield lies(name, words=words, daemon=EIGHT_BITS)
        for kind, change in (
            ("shift-x=3", "shifted by 3 cells"),
            ("shift-x=-3", "shifted by -3 cells"),
            ("mirror=1", "mirrored"),
        ):
            yield lies(f"{who}, image {change} at once", words=side + kind)
        words = f"{side}replay=0.6"
        yield lies(f"{who}, frames of 0.6 s repeated, then 20 N", words=words, then=20.0)
    for scale in (0.5, 2.0):
        words, false = f"{{side}}:current={scale}", ("{side}_current",)
        yield bounded(f"one servo's current x {scale:g} at once", words=words, false=false)
    for scale in (0.6, 0.8, 1.25, 1.6):
        odd = {"simulation": {"modulus_scale": scale}}
        yield settles(f"E of the tips x {scale:g}", daemon=odd)
    yield settles("solid tips, no fault", daemon=SOLID)
    for gain in (0.7, 1.3):
        lies = partial(settles, words=f"gain={gain}", false=_SENSORS, daemon=SOLID)
        yield lies(f"solid tips, both sensors, gain {gain:g} from the start", before=True)
        yield lies(f"solid tips, both sensors, gain {gain:g} at once")


CASES = tuple(
    replace(case, name=f"{force:g} N: {case.name}") for force in _FORCES for case in _cases(force)
)
NAMES = tuple(case.name for case in CASES)


@dataclass
class GripTrial:
    """Outcome of a trial.

    Forces are relative to the requested force. Times [s] are measured from the grasp or from the
    fault.
    """

    false: tuple[str, ...]  # channels that may be reported as faulty
    comes: float = 0.0  # time over which the fault develops [s]
    held: bool = True  # True if the mode `holding` was reached
    settled: float = math.nan  # mean final force of the two tips, or NaN if the object was released
    peak: float = 0.0  # maximum force of either tip
    above: float = 0.0
    slid: float = 0.0  # m
    end: str = ""  # final fault or mode
    events: list[tuple[float, str]] = field(default_factory=list)

    def named(self, rightly: bool) -> list[tuple[float, str]]:
        """Return (time, channel) of each correct diagnosis.

        If ``rightly`` is False, the wrong diagnoses are returned instead.
        """
        names = diagnoses(self.events)
        return [(t, name) for t, name in names if (name in self.false) == rightly]

    def missed(self, case: GripCase) -> list[str]:
        """Return the criteria that the trial did not meet."""
        low, high = _SETTLED_RANGE
        named = min((t for t, _ in self.named(True)), default=math.inf) - 0.5 * self.comes
        wrong = {
            "not held": not self.held and not case.before,
            "wrong report": bool(self.named(False)),
            "force": case.aim == SETTLES and not low <= self.settled <= high,
            "increased": case.aim == SETTLES and any(kind == "slip" for _, kind in self.events),
            "too much force": case.aim == BOUNDED and self.above > _EXCESS_TIME_MAX,
            "not reported": case.aim == BOUNDED and named > _REPORT_TIME_MAX,
        }
        return [why for why, true in wrong.items() if true]


def measure(
    brief: bool = False,
    trials: int | None = None,
    only: str = "",
    sweep: Callable[..., Iterable[Any]] = map,
) -> list[Report]:
    """Run the cases whose names contain ``only``; return one table per criterion.

    ``brief`` runs one trial per case. ``sweep`` maps trials to outcomes in one or more processes.
    """
    trials, reports = trials or (1 if brief else _TRIAL_COUNT), []
    cases = [case for case in CASES if only in case.name]
    cases.sort(key=lambda case: (SETTLES, BOUNDED).index(case.aim))
    seeds = range(1, trials + 1)
    outcomes = iter(sweep(_outcome, list(itertools.product(cases, seeds))))
    for aim, group in itertools.groupby(cases, lambda case: case.aim):
        rows = []
        for case in group:
            rows.append(summary(case, [GripTrial(**next(outcomes)) for _ in seeds]))
            print(f"{case.name}: {rows[-1]['met']} of {trials}", file=sys.stderr, flush=True)
        missed = sum(row["met"] < trials for row in rows)
        title, note = f"true force / commanded force: {aim}", f"  not met: {missed} of {len(rows)}"
        reports.append(Report(title, rows, notes=(note,), failed=missed > 0))
    return reports


def _outcome(drawn: tuple[GripCase, int]) -> dict[str, Any]:
    return asdict(trial(*drawn))


def trial(case: GripCase, seed: int) -> GripTrial:
    """Run one trial."""
    chance = random.Random(f"{case.name} {seed}")
    side = chance.choice(FINGERS)
    found = GripTrial(tuple(name.format(side=side) for name in case.false))
    words = case.words.format(side=side)
    with VirtualGrip.drawn(seed, chance, case.daemon) as grip:
        loop, state = grip.loop, grip.state
        if case.before:
            grip.begin(words)
        grip.command("arm")
        loop.advance(0.1 + chance.uniform(0.0, 0.02))
        watch, begin = grip.watched(case.force), state.t
        grip.command("grasp", force=case.force)
        found.held = grip.until("holding", _GRIP_TIMEOUT)
        loop.advance(_REST_TIME + chance.uniform(0.0, 0.02))
        if words and not case.before:
            watch, begin = grip.watched(case.force), state.t
            found.comes = grip.begin(words)
        if case.then:
            loop.advance(_REPEATED_LAG)
            watch.asked = case.then
            grip.command("grasp", force=case.then)
        loop.advance(found.comes + _OBSERVATION_TIME)
        found.settled = watch.settled() if state.mode in GRIPPING_MODES else math.nan
        found.peak, found.above, found.slid = watch.peak, watch.above, watch.slid
        found.end = state.fault_name or state.mode
        found.events = [(t - begin, kind) for t, kind in grip.alarms if t >= begin]
    return found


def summary(case: GripCase, found: Sequence[GripTrial]) -> Row:
    """Return a row with a case's force statistics, missed criteria and event times."""
    settled = [each.settled for each in found if not math.isnan(each.settled)]
    missed = [each.missed(case) for each in found]
    return {
        "name": case.name,
        "met": sum(not each for each in missed),
        "trials": len(found),
        "settled": median(settled) if settled else None,
        "lowest": min(settled, default=None),
        "highest": max(settled, default=None),
        "peak": max(each.peak for each in found),
        "above ms": 1e3 * max(each.above for each in found),
        "slid mm": 1e3 * median(each.slid for each in found),
        "lost": sum(each.slid > _SLIDE_MAX for each in found),
        "reported": _firsts([each.named(True) for each in found]),
        "wrong reports": _firsts([each.named(False) for each in found]),
        "missed": _counts(why for each in missed for why in each),
        "final state": _counts(each.end for each in found),
        "events": _firsts([each.events for each in found]),
    }


def _counts(words: Iterator[str]) -> str:
    return ", ".join(f"{word} {count}" for word, count in Counter(words).most_common())


def _firsts(trials: Sequence[Sequence[tuple[float, str]]]) -> str:
    """For each event kind, format the trial count and the median time of the first event [s]."""
    first: dict[str, list[float]] = {}
    for events in trials:
        for kind in dict.fromkeys(kind for _, kind in events):
            first.setdefault(kind, []).append(min(t for t, each in events if each == kind))
    return ", ".join(f"{kind} {len(at)} ({median(at):.2f} s)" for kind, at in first.items())
