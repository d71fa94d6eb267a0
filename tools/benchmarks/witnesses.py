"""Campaign: what a grip is measured by goes wrong, and the plant says what the grip does then.

Each case is a grip with a false measurement, an odd tip or a load; each trial of it draws from a
seed of its own noise, instants, the finger, the object's mass and an error of the joints' torque
constant. It runs on virtual time: nothing depends on the machine.
"""

from __future__ import annotations

import contextlib
import math
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import fmean, median

from softfinger.daemon.control.modes import GRIPPING
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import checked
from softfinger.daemon.simulation.faults import OBJECT, parse_faults
from softfinger.daemon.types import FINGERS
from softfinger.tools.benchmarks.measuring import Report, Row
from softfinger.tools.benchmarks.rigs import Sections, merged
from softfinger.tools.processes.kernel_build import table_cache

_TRIALS = 20
_FORCES = (6.0, 12.0)  # N asked for
_WITNESS = "witness."  # how the kinds of events begin that name a false measurement
_TORQUE_ERROR = 0.1  # share by which a joint's torque constant may be off

# Aims: forces over what was asked for; times [s].
SETTLES = "settled at 0.8 … 1.2, not raised"
BOUNDED = "≤ 50 ms above 1.3, named ≤ 0.3 s"
ANSWERED = "answered ≤ 22 ms"
_SETTLED = (0.8, 1.2)
_TOO_MUCH, _TOO_LONG = 1.3, 0.05
_NAMED = 0.3  # since it is wrong by half of what it comes to
_ANSWER = 0.022  # since the slip's onset
_RAISED = 1.25  # of the goal currents before
_LOST, _GONE = 0.010, 0.1  # m: beyond the latter it no longer matters how far

# A trial's course [s].
_GRIP = 2.5  # until the hand holds, at most
_REST = 1.2  # held in peace
_LOOK = 5.0  # looked at after what comes has come
_LOOK_ANSWER = 1.0
_REPEATED = 1.0  # of repeated frames, before another force is asked for
_LAST = 0.5  # over which the force has settled
_SLIPS = 0.999  # of what friction bears
_BORNE = {"push": 2.0 * 0.6, "twist": 0.6 * 0.040}  # N, N·m a N of grip: by both tips' friction
_SLIPPING = (1.17, 1.5)  # of that

# The honest hour, in as many pieces as there are trials.
_PIECE = 180.0  # s
_ASKED = (4.0, 20.0)  # N
_HELD = 0.7  # of what a grip bears, at most
_TURN = 0.14  # rad
_ACTIONS = ("loads", "turns", "new forces")


@dataclass(frozen=True)
class WitnessCase:
    """One kind of grip.

    ``words`` are faults as `softfinger emulate --fault` takes them, with ``{side}`` for a finger
    and ``{load}`` for a drawn number; they begin when the hand holds, or before the grasp.
    """

    name: str
    aim: str
    force: float  # asked for [N]
    words: str = ""
    false: tuple[str, ...] = ()  # what may be named
    comes: float = 0.0  # s in which it comes
    before: bool = False
    then: float = 0.0  # N asked for after a while
    loads: tuple[float, float] = (0.0, 0.0)  # between which `{load}` lies
    settings: Sections = field(default_factory=dict)


def _cases(force: float) -> Iterator[WitnessCase]:
    settles = partial(WitnessCase, aim=SETTLES, force=force)
    bounded = partial(WitnessCase, aim=BOUNDED, force=force)
    yield settles("honest")
    for who, side, false in (
        ("one sensor", "{side}:", ("{side}_sensor",)),
        ("both sensors", "", ("left_sensor", "right_sensor")),
    ):
        for gain in (0.5, 0.7, 0.85, 1.3, 1.6):
            lies, words = partial(settles, false=false), f"{side}gain={gain}"
            yield lies(f"{who}, gain {gain:g} from the start", words=words, before=True)
            yield lies(f"{who}, gain {gain:g} in 2 s", words=f"{words}@0..2", comes=2.0)
            yield lies(f"{who}, gain {gain:g} at once", words=words)
        lies = partial(bounded, false=false)
        for drift in (0.2, -0.2):
            words = f"{side}drift={drift}@0..2"
            yield lies(f"{who}, zero {drift:+.0%} of full scale in 2 s", words=words, comes=2.0)
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
        yield settles(f"E of the tips x {scale:g}", settings=odd)
    for kind, borne in _BORNE.items():
        low, high = (share * borne * force for share in _SLIPPING)
        words = f"{kind}={{load}}"
        yield WitnessCase(f"{kind} that slips", ANSWERED, force, words, loads=(low, high))


CASES = tuple(
    replace(case, name=f"{force:g} N: {case.name}") for force in _FORCES for case in _cases(force)
)
_HOUR = "honest hour"
NAMES = (*(case.name for case in CASES), _HOUR)


class Watch:
    """The true forces and the object's place, tick by tick."""

    def __init__(self, asked: float) -> None:
        self.asked = asked  # N
        self.peak = 0.0  # force over what is asked for, of either tip
        self.above = 0.0  # longest time above `_TOO_MUCH` [s]
        self.slid = 0.0  # by how much the object was displaced with torque on [m]
        self._mean: list[tuple[float, float]] = []  # when [s], force over what is asked for
        self._below = math.inf  # since then above
        self._place: Sequence[float] = ()

    def see(self, t: float, forces: Sequence[float], place: Sequence[float], torque: bool) -> None:
        """Take in time [s], both tips' forces [N], the object's place [m], whether torque is on."""
        ratios = [force / self.asked for force in forces]
        self._mean.append((t, fmean(ratios)))
        self.peak = max(self.peak, *ratios)
        self._below = min(self._below, t) if max(ratios) > _TOO_MUCH else math.inf
        self.above = max(self.above, t - self._below)
        self._place = self._place or place
        if torque:
            self.slid = min(max(self.slid, math.dist(place, self._place)), _GONE)

    def settled(self) -> float:
        """The mean force over what is asked for, in the end."""
        end = self._mean[-1][0] - _LAST
        return fmean(ratio for t, ratio in self._mean if t > end)


class VirtualGrip:
    """A simulated hand on virtual time and its events; ``look`` is called after each tick."""

    def __init__(self, seed: int, chance: random.Random, sections: Sections) -> None:
        drawn = {"seed": seed, "object_mass": 0.1 * 2.0 ** chance.uniform(-1.0, 1.0)}
        base = {"simulation": drawn, "loop": {"clock": "virtual"}}
        self.settings = checked(merged(sections, base))
        self.events: list[tuple[float, str]] = []  # warnings and errors: when [s], kind
        self._daemon = Daemon(
            self.settings, wire=False, table_cache=table_cache(), on_event=self._hear
        )
        self.loop, self.state = self._daemon.loop, self._daemon.loop.state
        assert self._daemon.hand is not None
        self.hand = self._daemon.hand
        error = chance.uniform(-_TORQUE_ERROR, _TORQUE_ERROR)
        self.hand.plant.parameters.torque_constant *= 1.0 + error
        self.look: Callable[[], None] = lambda: None
        self.loop.heartbeat = lambda _: self.look()
        self.loop.advance(0.1)

    def __enter__(self) -> VirtualGrip:
        return self

    def __exit__(self, *_: object) -> None:
        self._daemon.close()

    def _hear(self, level: str, kind: str, _text: str) -> None:
        if level != "info":
            self.events.append((self._daemon.clock.now(), kind))

    def command(self, name: str, **numbers: float) -> None:
        """Give a command, which the hand may refuse."""
        with contextlib.suppress(Refused):
            self.loop.command({"command": name, **numbers})

    def until(self, mode: str, seconds: float) -> bool:
        """Go on until the hand is in that mode; False when it is not within ``seconds``."""
        end = self.state.t + seconds
        while self.state.mode != mode and self.state.t < end:
            self.loop.advance(self.loop.period)
        return self.state.mode == mode

    def begin(self, words: str) -> None:
        """Let begin now what these words of `softfinger emulate --fault` say."""
        for after, part, kind, value, over in parse_faults(words.split(), ()):
            if part == OBJECT:
                self.hand.load(**{kind: value})
            else:
                faults = self.hand.measurement_faults[FINGERS.index(part)]
                faults.begin(kind, value, self.state.t + after, over)

    def place(self) -> None:
        """Put the object back where it was at the start, at rest and without a load."""
        simulation = self.settings.simulation
        self.hand.object_pose[:] = *simulation.object_position, simulation.object_angle
        self.hand.object_velocity[:] = 0.0
        self.hand.load()
        self.hand.refresh()

    def watched(self, asked: float) -> Watch:
        """A watch that sees each tick from now on."""
        watch, hand, state = Watch(asked), self.hand, self.state
        self.look = lambda: watch.see(
            state.t, hand.force.tolist(), hand.object_pose[:2].tolist(), state.torque
        )
        return watch

    def answer(self, words: str, seconds: float) -> float:
        """From the onset of the slip that ``words`` cause to raised goal currents [s].

        NaN where nothing slips in so many ``seconds``, infinity without an answer.
        """
        state, loop = self.state, self.loop
        calm = sum(state.goal.current)
        self.begin(words)
        onset = answered = math.inf
        stuck, end = state.t, state.t + seconds
        while state.t < end:
            loop.advance(loop.period)
            if self._slips():
                onset = min(onset, stuck)
            stuck = state.t
            if sum(state.goal.current) > _RAISED * calm:
                answered = min(answered, state.t)
        return answered - onset if onset < math.inf else math.nan

    def _slips(self) -> bool:
        most = _SLIPS * self.settings.simulation.tip_friction
        tips = zip(self.hand.tangential.tolist(), self.hand.normal.tolist(), strict=True)
        return any(abs(along) >= most * normal for along, normal in tips)


@dataclass
class GripTrial:
    """What came of a trial: forces over what was asked for, times since it began [s]."""

    false: tuple[str, ...]  # what may be named
    held: bool = True  # before anything went wrong
    settled: float = math.nan  # mean of both tips at the end; NaN when they were let go
    peak: float = 0.0  # of either tip
    above: float = 0.0
    answer: float = math.nan
    slid: float = 0.0  # m
    end: str = ""  # fault or mode
    events: list[tuple[float, str]] = field(default_factory=list)

    def see(self, watch: Watch, mode: str, fault: str, events: list[tuple[float, str]]) -> None:
        """Take over what was watched, and how it ended."""
        self.settled = watch.settled() if mode in GRIPPING else math.nan
        self.peak, self.above, self.slid = watch.peak, watch.above, watch.slid
        self.end, self.events = fault or mode, events

    def named(self, rightly: bool) -> list[tuple[float, str]]:
        """What was named and when: what is false, or what is not."""
        names = [(t, k.removeprefix(_WITNESS)) for t, k in self.events if k.startswith(_WITNESS)]
        return [(t, name) for t, name in names if (name in self.false) == rightly]

    def missed(self, case: WitnessCase) -> list[str]:
        """The parts of the aim that were missed."""
        low, high = _SETTLED
        named = min((t for t, _ in self.named(True)), default=math.inf) - 0.5 * case.comes
        wrong = {
            "not held": not self.held and not case.before,
            "named wrongly": bool(self.named(False)),
            "force": case.aim == SETTLES and not low <= self.settled <= high,
            "raised": case.aim == SETTLES and any(kind == "slip" for _, kind in self.events),
            "too strong": case.aim == BOUNDED and self.above > _TOO_LONG,
            "not named": case.aim == BOUNDED and named > _NAMED,
            "no answer": case.aim == ANSWERED and self.answer > _ANSWER,
        }
        return [why for why, true in wrong.items() if true]


def measure(trials: int | None = None, only: str = "") -> list[Report]:
    """Every case whose name ``only`` is found in, and the honest hour in ``trials`` pieces."""
    trials = trials or _TRIALS
    reports = []
    for aim in (SETTLES, BOUNDED, ANSWERED):
        rows = []
        for case in CASES:
            if case.aim == aim and only in case.name:
                found = [trial(case, seed) for seed in range(1, trials + 1)]
                rows.append(summary(case, found))
                print(f"{case.name}: {rows[-1]['met']} of {trials}", file=sys.stderr, flush=True)
        if rows:
            reports.append(_report(f"force over asked: {aim}", rows))
    if only in _HOUR:
        reports.append(_report("nothing false: nothing named", [honest(trials)]))
    return reports


def _report(title: str, rows: list[Row]) -> Report:
    missed = sum(row["met"] < row["trials"] for row in rows)
    return Report(title, rows, notes=(f"  not met: {missed} of {len(rows)}",), failed=missed > 0)


def trial(case: WitnessCase, seed: int) -> GripTrial:
    """One grip of a case."""
    chance = random.Random(f"{case.name} {seed}")
    found, words = drawn(case, chance)
    with VirtualGrip(seed, chance, case.settings) as grip:
        loop, state = grip.loop, grip.state
        if case.before:
            grip.begin(words)
        grip.command("arm")
        loop.advance(0.1 + chance.uniform(0.0, 0.02))
        watch, begin = grip.watched(case.force), state.t
        grip.command("grasp", force=case.force)
        found.held = grip.until("holding", _GRIP)
        loop.advance(_REST + chance.uniform(0.0, 0.02))
        if words and not case.before:
            watch, begin = grip.watched(case.force), state.t
        if case.aim == ANSWERED:
            found.answer = grip.answer(words, _LOOK_ANSWER)
        else:
            if not case.before:
                grip.begin(words)
            if case.then:
                loop.advance(_REPEATED)
                watch.asked = case.then
                grip.command("grasp", force=case.then)
            loop.advance(case.comes + _LOOK)
        events = [(t - begin, kind) for t, kind in grip.events if t >= begin]
        found.see(watch, state.mode, state.fault_name, events)
    return found


def drawn(case: WitnessCase, chance: random.Random) -> tuple[GripTrial, str]:
    """A trial's finger and load: what may be named, and the case's words with them."""
    side, load = chance.choice(FINGERS), f"{chance.uniform(*case.loads):.3f}"
    found = GripTrial(tuple(name.format(side=side) for name in case.false))
    return found, case.words.format(side=side, load=load)


def summary(case: WitnessCase, found: Sequence[GripTrial]) -> Row:
    """A case's row: median and extremes of its trials, what was missed, and when events came."""
    settled = [each.settled for each in found if not math.isnan(each.settled)]
    missed = [each.missed(case) for each in found]
    row: Row = {
        "name": case.name,
        "met": sum(not each for each in missed),
        "trials": len(found),
        "settled": median(settled) if settled else None,
        "least": min(settled, default=None),
        "most": max(settled, default=None),
        "peak": max(each.peak for each in found),
        "above ms": 1e3 * max(each.above for each in found),
        "slid mm": 1e3 * median(each.slid for each in found),
        "lost": sum(each.slid > _LOST for each in found),
    }
    if case.aim == ANSWERED:
        answers = [1e3 * each.answer for each in found if not math.isnan(each.answer)]
        row["answer ms"] = median(answers) if answers else None
        row["answer ms at most"] = max(answers, default=None)
    return row | {
        "named": _firsts([each.named(True) for each in found]),
        "named wrongly": _firsts([each.named(False) for each in found]),
        "missed": _counts(why for each in missed for why in each),
        "in the end": _counts(each.end for each in found),
        "events": _firsts([each.events for each in found]),
    }


def _counts(words: Iterator[str]) -> str:
    return ", ".join(f"{word} {count}" for word, count in Counter(words).most_common())


def _firsts(trials: Sequence[Sequence[tuple[float, str]]]) -> str:
    """Of each kind in how many trials it came, and the median of when it first did [s]."""
    first: dict[str, list[float]] = {}
    for events in trials:
        for kind in dict.fromkeys(kind for _, kind in events):
            first.setdefault(kind, []).append(min(t for t, each in events if each == kind))
    return ", ".join(f"{kind} {len(at)} ({median(at):.2f} s)" for kind, at in first.items())


# The honest hour


def honest(trials: int) -> Row:
    """The row of ``trials`` pieces: grips, loads, turns and releases by a hand that measures truly.

    ``settled`` is the true force over the one that the hand goes to, which loads raise.
    """
    done: Counter[str] = Counter()
    settled: list[float] = []
    found = []
    for seed in range(1, trials + 1):
        chance = random.Random(f"{_HOUR} {seed}")
        with VirtualGrip(seed, chance, {}) as grip:
            while grip.state.t < _PIECE:
                _handle(grip, chance, done, settled)
            found.append(GripTrial((), events=grip.events))
    named = [each.named(False) for each in found]
    return {
        "name": f"{_HOUR}: {trials * _PIECE / 60.0:g} min",
        "met": sum(not each for each in named),
        "trials": trials,
        **{what: done[what] for what in ("grips", *_ACTIONS, "not held", "let go")},
        "settled": median(settled),
        "least": min(settled),
        "most": max(settled),
        "named wrongly": _firsts(named),
        "events": _firsts([each.events for each in found]),
    }


def _handle(
    grip: VirtualGrip, chance: random.Random, done: Counter[str], settled: list[float]
) -> None:
    """One grip, from open fingers to open fingers."""
    for name in ("clear", "arm", "release"):
        grip.command(name)
        grip.loop.advance(0.1)
    grip.until("armed", _GRIP)
    grip.place()
    force = chance.uniform(*_ASKED)
    grip.command("grasp", force=force)
    if not grip.until("holding", _GRIP):
        done["not held"] += 1
        return
    done["grips"] += 1
    for _ in range(chance.randint(1, 5)):
        grip.loop.advance(chance.uniform(0.2, 1.5))
        action = chance.choice(_ACTIONS)
        done[action] += 1
        if action == "loads":
            kind = chance.choice(tuple(_BORNE))
            grip.hand.load(**{kind: chance.uniform(-_HELD, _HELD) * _BORNE[kind] * force})
            grip.loop.advance(chance.uniform(0.2, 1.5))
            grip.hand.load()
        elif action == "turns":
            grip.command("rotate", angle=chance.uniform(-_TURN, _TURN))
        else:
            force = chance.uniform(*_ASKED)
            grip.command("grasp", force=force)
        if not grip.until("holding", _GRIP):
            done["let go"] += 1
            return
    grip.loop.advance(_REST)
    settled.append(fmean(grip.hand.force.tolist()) / grip.state.goal.force)
