"""Measure the true grip force of hands that differ from their settings.

The simulated hand and the daemon have separate settings. In each of the *rows*, one parameter
differs from its setting by an amount that is typical of a healthy hand. In the *ensemble*, all
parameters are drawn at random. If MuJoCo is installed, the first hands of the ensemble also grip an
object in MuJoCo, without the stiction and relaxation that this plant does not simulate. In the
*sensor grips*, only the object's mass and the torque constant differ from the settings, and the
object is rotated. Grips run in virtual time, so the results do not depend on the machine.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from softfinger.daemon.control.modes import GRIPPING_MODES
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.tools.benchmarks.faults import EIGHT_BITS
from softfinger.tools.benchmarks.measuring import Report
from softfinger.tools.benchmarks.rigs import (
    SENSORS,
    GripCase,
    Sections,
    VirtualGrip,
    diagnoses,
    merged,
)

_TRIAL_COUNT, _HAND_COUNT, _MUJOCO_COUNT = 20, 400, 100
# Time limit for reaching the mode `holding`, undisturbed holding time, and observation time [s].
_GRIP_TIMEOUT, _REST_TIME, _OBSERVATION_TIME = 8.0, 1.2, 6.0
_ERROR_MAX, _ERROR_FAR = 0.2, 0.3  # limits for the relative force error
_REPORT_TIME_MAX = 2.0  # time limit for reporting a force error above `_ERROR_MAX` [s]
# Limits before a load is applied: ratio of force to requested force, and time above it [s].
_EXCESS_RATIO, _EXCESS_TIME_MAX = 1.4, 0.1
# Logarithm of the gain error above which the daemon may report a faulty sensor.
_GAIN_ERROR_MIN = math.log(1.3)
_LOAD_FRACTION = 0.8  # loads below this fraction of the friction limit must be held

_LATENCY = Settings().tactile.latency


def _hand(**simulation: Any) -> Sections:
    return {"simulation": simulation}


_BOTH_SENSORS = tuple(f"{side}_sensor" for side in FINGERS)
_RELAXATION = (0.1, 0.2, 0.2)
ROWS = (
    GripCase("as set", 6.0),
    GripCase("joint friction 0.12 N·m", 6.0, _hand(joint_friction=0.12)),
    GripCase("joint friction 0.20 N·m", 12.0, _hand(joint_friction=0.20)),
    GripCase("stiction 0.15 N·m", 6.0, _hand(joint_stribeck=0.15)),
    *(
        GripCase(
            f"zero {drift:+.0%} in {s} s{of}",
            6.0,
            daemon=board,
            words=f"drift={drift}@0..{s}",
            false=_BOTH_SENSORS,
        )
        for of, board in (("", {}), (", 8 bits", EIGHT_BITS))
        for drift, s in ((-0.05, 20), (-0.02, 20), (0.05, 20), (-0.05, 120))
    ),
    *(
        GripCase(f"frames {ms} ms older", force, _hand(tactile_delay=_LATENCY + 1e-3 * ms))
        for ms, force in ((15, 12.0), (30, 6.0), (10, 20.0))
    ),
    GripCase("rubber that relaxes", 6.0, _hand(tip_relaxation=_RELAXATION)),
    GripCase("cells of 80 ms", 6.0, _hand(tactile_response=0.08)),
    GripCase("both of these", 6.0, _hand(tip_relaxation=_RELAXATION, tactile_response=0.08)),
    GripCase(
        "both gains and currents halve in 5 s",
        6.0,
        words="gain=0.5@0..5 left:current=0.5@0..5 right:current=0.5@0..5",
        false=(*_BOTH_SENSORS, "left_current", "right_current"),
    ),
    GripCase(
        "both images wander by 6 cells in 60 s", 6.0, words="shift-x=6@0..60", false=_BOTH_SENSORS
    ),
)

_IDEAL = "ideal"  # sensor that adds only noise
_SENSOR_COUNT = 24  # number of grips with each sensor
_TURN = math.radians(8.0)
_SIGMA = 1.96  # half width of a 95 % interval, in standard deviations
_ENSEMBLE, _MUJOCO = "hand ", "mujoco "
NAMES = (
    *(case.name for case in ROWS),
    *(f"{_ENSEMBLE}{seed}" for seed in range(1, _HAND_COUNT + 1)),
    *(f"{_MUJOCO}{seed}" for seed in range(1, _MUJOCO_COUNT + 1) if find_spec("mujoco")),
    *(f"{sensor} {k}" for sensor in (_IDEAL, *SENSORS) for k in range(1, _SENSOR_COUNT + 1)),
)


def drawn(seed: int) -> GripCase:
    """Create a random hand for the ensemble; all its parameters differ from the settings."""
    chance = random.Random(f"{_ENSEMBLE}{seed}")

    def span(low: float, high: float) -> float:
        return chance.uniform(low, high)

    def ratio(low: float, high: float) -> float:
        return math.exp(chance.uniform(math.log(low), math.log(high)))

    calibrated = chance.random() < 0.5
    modulus = span(0.95, 1.05) if calibrated else ratio(0.6, 1.6)
    gains = ratio(0.6, 1.5), ratio(0.6, 1.5)
    friction, force = span(0.3, 0.8), span(3.0, 20.0)
    relaxing = [chance.random() for _ in range(3)]
    relaxing = [span(0.0, 0.5) * each / sum(relaxing) for each in relaxing]
    noise = ratio(0.5, 2.0) * Settings().tactile.noise
    hand = merged(
        {"tactile": {"centre": (span(-1e-3, 1e-3), span(-1e-3, 1e-3))}},
        _hand(
            seed=seed,
            joint_friction=ratio(0.02, 0.20),
            joint_stribeck=span(0.0, 0.1),
            tactile_gain=gains,
            modulus_scale=modulus,
            tactile_delay=_LATENCY + span(0.0, 0.04),
            tip_relaxation=tuple(relaxing),
            tactile_response=span(0.0, 0.08),
            tip_friction=friction,
            object_mass=ratio(0.02, 1.0),
            tactile_noise=noise,
        ),
    )
    hand["tactile"]["rotation"] = tuple(math.radians(span(-5.0, 5.0)) for _ in FINGERS)
    drifts = {side: span(-0.05, 0.05) for side in FINGERS}
    over = span(10.0, 120.0)
    words = " ".join(f"{side}:drift={drift:.4f}@0..{over:.1f}" for side, drift in drifts.items())
    off = (abs(math.log(gain)) > _GAIN_ERROR_MIN for gain in gains)
    pushed, turned = chance.random() < 0.5, chance.random() < 0.5
    return GripCase(
        f"{_ENSEMBLE}{seed}",
        force,
        hand,
        {"material": {"modulus_error": 0.05 if calibrated else 0.0}},
        span(0.85, 1.15),
        words,
        load=chance.choice((-1.0, 1.0))
        * span(0.0, _LOAD_FRACTION)
        * 2.0
        * friction
        * force
        * pushed,
        within=chance.choice((0.0, 0.3, 2.0)),
        turn=span(-0.14, 0.14) * turned,
        # Zero-offset drift also counts as a sensor fault.
        false=tuple(
            f"{side}_sensor"
            for side, wrong in zip(FINGERS, off, strict=True)
            if wrong or abs(drifts[side]) > 0.01
        ),
    )


def drawn_in_mujoco(seed: int) -> GripCase:
    """Create the same hand as `drawn` in MuJoCo, without stiction and relaxation."""
    case = drawn(seed)
    mujoco: Sections = {"servos": {"backend": "mujoco"}, "plugins": {"mujoco": {"timestep": 1e-3}}}
    constant = case.torque * Settings().control.torque_constant
    hand = merged({"control": {"torque_constant": constant}}, merged(mujoco, case.hand))
    hand["simulation"] = {
        key: value
        for key, value in hand["simulation"].items()
        if key not in ("joint_stribeck", "tip_relaxation")
    }
    daemon = merged(mujoco, case.daemon)
    return replace(case, name=f"{_MUJOCO}{seed}", hand=hand, daemon=daemon, torque=1.0)


def sensor_grips(sensor: str) -> Iterator[GripCase]:
    """Yield grips of 4, 8 and 12 N with a sensor; the object is rotated by ±8°."""
    for k in range(1, _SENSOR_COUNT + 1):
        name = f"{sensor} {k}"
        chance = random.Random(name)
        mass = 0.1 * 2.0 ** chance.uniform(-1.0, 1.0)
        force = (4.0, 8.0, 12.0)[k % 3]
        torque = chance.uniform(0.9, 1.1)
        hand, turn = _hand(seed=k, object_mass=mass), math.copysign(_TURN, k % 2 - 0.5)
        daemon = SENSORS.get(sensor, {})
        yield GripCase(name, force, hand, daemon, torque, turn=turn, tares=True)


@dataclass
class Outcome:
    """Outcome of a grip. Forces are relative to the requested force, and times are in s."""

    held: bool = False  # True if the mode `holding` was reached
    estimate_error: float = math.nan  # (estimated − true force)/true force, mean of the tips
    inside_count: int = 0  # number of tips whose true force is inside the published 95 % interval
    angle_error: float = math.nan  # true − commanded object angle [rad]
    settled: float = math.nan  # mean final force of the two tips, or NaN if the object was released
    peak: float = 0.0  # maximum force of either tip before the load is applied
    above: float = 0.0  # longest time above `_EXCESS_RATIO` before the load [s]
    first_off: float = math.inf  # time when the mean error first rose above `_ERROR_MAX` [s]
    named: float = math.inf  # time of the first diagnosis [s]
    accused: tuple[str, ...] = ()  # channels that were wrongly diagnosed as faulty
    raised: bool = False  # True if the force was increased before the load
    lost: bool = False
    end: str = ""  # final fault or mode

    def well(self) -> bool:
        """Return True if the force error is below `_ERROR_MAX` or was reported in time."""
        near = self.held and abs(self.settled - 1.0) <= _ERROR_MAX and self.above == 0.0
        is_reported = self.named - self.first_off <= _REPORT_TIME_MAX and not self.raised
        return near or (self.first_off < math.inf and is_reported)


def grip(case: GripCase, seed: int = 1) -> Outcome:
    """Run one grip; ``seed`` determines the noise and the random delays."""
    chance, found = random.Random(f"{case.name} {seed}"), Outcome()
    daemon = merged({"simulation": {"seed": seed}}, case.daemon)
    with VirtualGrip(daemon, merged(case.hand, daemon), case.torque) as hand:
        loop, state = hand.loop, hand.state
        if case.tares:
            hand.command("tare")
            loop.advance(0.5)
        hand.command("arm")
        loop.advance(0.1 + chance.uniform(0.0, 0.02))
        watch, begin = hand.watched(case.force, _EXCESS_RATIO), state.t
        hand.command("grasp", force=case.force)
        found.held = hand.until("holding", _GRIP_TIMEOUT)
        loop.advance(_REST_TIME + chance.uniform(0.0, 0.02))
        loop.advance(hand.begin(case.words) + _OBSERVATION_TIME)
        if case.turn:
            hand.command("rotate", angle=case.turn)
            loop.advance(2.0)
        gripped = state.mode in GRIPPING_MODES
        found.settled = watch.settled() if gripped else math.nan
        if gripped:
            force, std = np.array([[each.force, each.force_std] for each in state.contacts]).T
            off = force - hand.plant.force
            found.estimate_error = float((off / hand.plant.force).mean())
            found.inside_count = int(np.count_nonzero(np.abs(off) < _SIGMA * std))
            found.angle_error = float(hand.plant.object_pose[2]) - case.turn
        found.peak, found.above, found.raised = watch.peak, watch.above, watch.raised
        found.first_off = watch.first_off(_ERROR_MAX)
        if case.load and gripped and hand.between():
            hand.look = lambda: None  # Observe only the grip without the load.
            hand.pull(case.load, case.within, 20)
            loop.advance(2.0)
            found.lost = not hand.between()
        found.end = state.fault_name or str(state.mode)
        names = [(t - begin, name) for t, name in diagnoses(hand.alarms)]
    found.accused = tuple(dict.fromkeys(name for _, name in names if name not in case.false))
    found.first_off -= begin
    # A diagnosis of any channel counts as a report of the force error.
    found.named = min((t for t, _ in names), default=math.inf)
    return found


def _outcome(drawn_case: tuple[GripCase, int]) -> dict[str, Any]:
    return asdict(grip(*drawn_case))


def measure(
    brief: bool = False,
    trials: int | None = None,
    only: str = "",
    sweep: Callable[..., Iterable[Any]] = map,
) -> list[Report]:
    """Return a table for the rows and a table for the ensemble; ``brief`` runs only a few cases."""
    trials = trials or (1 if brief else _TRIAL_COUNT)
    share = 0.01 if brief else trials / _TRIAL_COUNT
    rows = [case for case in ROWS if only in case.name]
    ensembles = [
        [case for case in map(draw, range(1, round(share * count) + 1)) if only in case.name]
        for draw, count in ((drawn, _HAND_COUNT), (drawn_in_mujoco, _MUJOCO_COUNT))
        if draw is drawn or find_spec("mujoco")
    ]
    sensors = {
        sensor: [case for case in sensor_grips(sensor) if only in case.name and not brief]
        for sensor in (_IDEAL, *SENSORS)
    }
    seeds = range(1, trials + 1)
    jobs = [(case, seed) for case in rows for seed in seeds]
    jobs += [(hand, 1) for hands in (*ensembles, *sensors.values()) for hand in hands]
    outcomes = (Outcome(**each) for each in sweep(_outcome, jobs))
    reports = []
    if rows:
        table = [_row(case, [next(outcomes) for _ in seeds]) for case in rows]
        failed = any(row["passed"] < trials for row in table)
        reports.append(
            Report("true force / commanded force, one difference per case", table, failed=failed)
        )
    for title, hands in zip(("random hands", "random hands in MuJoCo"), ensembles, strict=False):
        if hands:
            reports.append(_ensemble(title, hands, [next(outcomes) for _ in hands]))
    grips = {name: [next(outcomes) for _ in cases] for name, cases in sensors.items() if cases}
    if grips:
        reports.append(Report("grips", [_sensor_row(*each) for each in grips.items()]))
    return reports


def _sensor_row(sensor: str, found: list[Outcome]) -> dict[str, Any]:
    def rms(errors: Iterable[float]) -> float:
        return float(np.sqrt(np.mean(np.square(list(errors)))))

    return {
        "name": sensor,
        "held": sum(each.held for each in found),
        "of": len(found),
        "true − commanded force, rms %": 100.0 * rms(each.settled - 1.0 for each in found),
        "estimated − true, rms %": 100.0 * rms(each.estimate_error for each in found),
        "inside the 95 % interval": sum(each.inside_count for each in found),
        "angle, rms °": math.degrees(rms(each.angle_error for each in found)),
    }


def _row(case: GripCase, found: list[Outcome]) -> dict[str, Any]:
    settled = sorted(each.settled for each in found if not math.isnan(each.settled))
    well = sum(each.well() for each in found)
    print(f"{case.name}: {well} of {len(found)}", file=sys.stderr, flush=True)
    return {
        "name": f"{case.force:g} N: {case.name}",
        "passed": well,
        "trials": len(found),
        "lowest": settled[0] if settled else None,
        "highest": settled[-1] if settled else None,
        "peak": max(each.peak for each in found),
        "above s": max(each.above for each in found),
        "increased": sum(each.raised for each in found),
        "reported": sum(each.named < math.inf for each in found),
        "wrong reports": sum(bool(each.accused) for each in found),
        "released": sum(math.isnan(each.settled) for each in found),
    }


def _ensemble(title: str, hands: list[GripCase], found: list[Outcome]) -> Report:
    count = len(found)

    def share(what: str, aim: str, number: int, of: int = count) -> dict[str, Any]:
        return {"name": what, "aim": aim, "number": number, "of": of, "%": 100.0 * number / of}

    off = [abs(each.settled - 1.0) for each in found]
    loaded = [each for case, each in zip(hands, found, strict=True) if case.load]
    rows = [
        share("true force within 20 %", "≥ 90 %", sum(each <= _ERROR_MAX for each in off)),
        share("within 30 %", "≥ 98 %", sum(each <= _ERROR_FAR for each in off)),
        share(
            "force above 1.4 for 0.1 s without a load",
            "0",
            sum(e.above > _EXCESS_TIME_MAX for e in found),
        ),
        share("objects lost", "≤ 1 %", sum(e.lost for e in loaded), max(len(loaded), 1)),
        share("healthy measurement channel reported", "≤ 2 %", sum(bool(e.accused) for e in found)),
        share(
            "true tip force inside the 95 % interval",
            "90–98 %",
            sum(each.inside_count for each in found),
            max(2 * sum(not math.isnan(each.settled) for each in found), 1),
        ),
        share("never held", "", sum(not each.held for each in found)),
        share("released", "", sum(math.isnan(each.settled) for each in found)),
        share("force increased without a load", "", sum(each.raised for each in found)),
    ]
    return Report(f"{count} {title}", rows)
