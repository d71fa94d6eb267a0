"""The control laws on the simulated hand: how fast, how exact and how firm, on virtual time.

What is judged is the plant's truth, not what the daemon believes: forces on the tips' bases, the
object's angle, the friction that is left. Nothing here depends on the machine's speed but the last
row.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.assembly import Daemon
from daemon.servos.registers import COUNTS_PER_TURN
from daemon.settings import Settings
from daemon.simulation.hand import SimulatedHand
from tools.benchmarks.report import Row, row

_FORCE = 10.0  # N
_ANGLE = math.radians(10.0)
_NEAR_FORCE = 0.02  # share: settled
_NEAR_ANGLE = math.radians(0.2)
_WATCHED = 4.0  # s after a command
_STEADY = 1.0  # s at the end of that
_OFF = (0.7, 1.0, 1.3)  # true mass and modulus over the settings'
_HELD = 600.0  # s under pushes
_PUSH = 0.2  # of the grip
_PAPER: dict[str, dict[str, Any]] = {
    "material": {"law": "constant", "modulus": 0.304e6},
    "tactile": {"rate": 25.0},
    "simulation": {"tactile_delay": 0.040},
}
_SLOW: dict[str, dict[str, Any]] = {
    "tactile": {"rate": 25.0},
    "simulation": {"tactile_delay": 0.040},
}


def measure() -> list[Row]:
    """All that the control is judged by; p99 of a few trials is about the worst of them."""
    rows = []
    profiles = {"100 Hz frames": {}, "25 Hz frames": _SLOW, "paper, 25 Hz": _PAPER}
    for name, sections in profiles.items():
        rows += _judged(name, _trials(sections))
    rows += _judged("two_phase, paper, 25 Hz", _trials(_PAPER, law="two_phase"))
    felt = _trials(_PAPER, law="position")
    rows += _judged("position + both integrals, paper, 25 Hz", felt)
    alone = _trials(_PAPER, law="position", force_bandwidth=0.0, rotate_bandwidth=0.0)
    rows += _judged("position alone, paper, 25 Hz", alone)
    rows += _pushed("paper, 25 Hz", _PAPER)
    rows.append(_one_count())
    rows.append(_speed())
    return rows


@dataclass
class Trials:
    """Figures of all trials of one kind."""

    overshoot: list[float] = field(default_factory=list)  # %
    settled: list[float] = field(default_factory=list)  # s
    steady: list[float] = field(default_factory=list)  # %
    turned: list[float] = field(default_factory=list)  # s, by 10°
    turned_far: list[float] = field(default_factory=list)  # s, by 20°
    angle: list[float] = field(default_factory=list)  # °
    kept: list[float] = field(default_factory=list)  # %
    slip: list[float] = field(default_factory=list)  # share of the friction that is used
    lost: int = 0


def _judged(name: str, trials: Trials) -> list[Row]:
    figures = (
        ("grasp, overshoot of either tip", "%", trials.overshoot, 10.0),
        ("grasp, settled within 2 % after contact", "s", trials.settled, 1.0),
        ("grasp, steady error of the mean force", "%", trials.steady, 2.0),
        ("rotate by 10°, settled within 0.2°", "s", trials.turned, 1.5),
        ("rotate by 20°, settled within 0.2°", "s", trials.turned_far, 1.5),
        ("rotate, steady error", "°", trials.angle, 0.2),
        ("rotate, either tip's force off its target", "%", trials.kept, 10.0),
        ("rotate, friction used, 1 slips", "", trials.slip, 1.0),
        ("grasps or turns that failed", "", [float(trials.lost)], 0.0),
    )
    return [
        row(f"{name}: {text}", unit, samples, aim)
        for text, unit, samples, aim in figures
        if samples
    ]


def _trials(sections: dict[str, dict[str, Any]], **control: Any) -> Trials:
    """Grasp, turn to both sides, with the object's mass and the tips' modulus off."""
    trials = Trials()
    for mass in _OFF:
        for modulus in _OFF:
            merged = {key: dict(value) for key, value in sections.items()}
            merged["control"] = control
            merged["simulation"] = merged.get("simulation", {}) | {
                "object_mass": 0.10 * mass,
                "modulus_scale": modulus,
            }
            with Watched(merged) as hand:
                _one_trial(hand, trials)
    return trials


def _one_trial(hand: Watched, trials: Trials) -> None:
    hand.grasp(_FORCE)
    seen = hand.watch(_WATCHED)
    touched = np.flatnonzero((seen.force > 0.3).all(axis=1))
    if not len(touched):
        trials.lost += 1
        return
    seen = seen.since(int(touched[0]))
    trials.overshoot.append(100.0 * max(float(seen.force.max()) / _FORCE - 1.0, 0.0))
    mean = seen.force.mean(axis=1)
    trials.settled.append(seen.settled(np.abs(mean - _FORCE) > _NEAR_FORCE * _FORCE))
    last = mean[seen.t > seen.t[-1] - _STEADY]
    trials.steady.append(100.0 * abs(float(last.mean()) / _FORCE - 1.0))
    if hand.mode != "holding":
        trials.lost += 1
        return
    for angle, far in ((_ANGLE, False), (-_ANGLE, True)):
        hand.command("rotate", angle=angle)
        seen = hand.watch(_WATCHED)
        if hand.mode != "holding":
            trials.lost += 1
            return
        off = np.abs(seen.angle - angle)
        (trials.turned_far if far else trials.turned).append(seen.settled(off > _NEAR_ANGLE))
        last = seen.angle[seen.t > seen.t[-1] - _STEADY]
        trials.angle.append(math.degrees(abs(float(last.mean()) - angle)))
        trials.kept.append(100.0 * float(np.abs(seen.force / _FORCE - 1.0).max()))
        trials.slip.append(float(seen.slip.max()))


def _pushed(name: str, sections: dict[str, dict[str, Any]]) -> list[Row]:
    """A held object pushed at random: a new force every 0.2 to 1 s, up to a share of the grip."""
    rng = np.random.default_rng(7)
    with Watched(sections) as hand:
        hand.grasp(_FORCE)
        hand.watch(2.0)
        before = hand.plant.object_pose.copy()
        start = float(before[2])
        off, angle, lost = [], [], 0
        finish = hand.now + _HELD
        while hand.now < finish:
            size, way = _PUSH * _FORCE * rng.random(), rng.uniform(-math.pi, math.pi)
            hand.plant.push(size * math.cos(way), size * math.sin(way))
            seen = hand.watch(rng.uniform(0.2, 1.0))
            off.append(100.0 * float(np.abs(seen.force.mean(axis=1) / _FORCE - 1.0).max()))
            angle.append(math.degrees(float(np.abs(seen.angle - start).max())))
            lost += hand.mode != "holding"
        hand.plant.push(0.0, 0.0)
        hand.watch(2.0)
        left = hand.plant.object_pose - before
    held = f"{name}: 10 min of pushes to {100 * _PUSH:.0f} % of the grip"
    return [
        row(f"{held}, mean force off", "%", off),
        row(f"{held}, angle off", "°", angle),
        row(f"{held}, angle left after", "°", [math.degrees(abs(left[2]))], 0.2),
        row(f"{held}, place left after", "mm", [1e3 * math.hypot(left[0], left[1])]),
        row(f"{held}, lost", "", [float(lost)], 0.0),
    ]


def _one_count() -> Row:
    """What one count of both joints does to the force: the finest step of position control."""
    settings = Settings.model_validate(_PAPER)
    hand = SimulatedHand(settings)
    contact = hand.table(np.array([4e-3]), np.array([math.radians(10.0)]))
    arm = settings.hand.finger_length * math.cos(math.radians(10.0))
    # Each joint presses its own tip by arm · count; the object stays in the middle.
    step = float(contact.force_d[0]) * arm * 2.0 * math.pi / COUNTS_PER_TURN
    return row("paper: one count of both joints at d = 4 mm", "N", [step])


def _speed() -> Row:
    """Simulated over real time in the plant's kernel, with the sub-steps it chose."""
    hand = SimulatedHand(Settings())
    hand.advance(1.0)
    samples = []
    for k in range(5):
        before = time.perf_counter()
        hand.advance(3.0 + 2.0 * k)
        samples.append(2.0 / (time.perf_counter() - before))
    return row("the plant alone, times real time (200 are asked for)", "", samples)


def push_along(hand: Watched, force: float, rate: float, start: float = 0.0) -> float:
    """Push the object along its faces from ``start`` to ``force`` [N], ``rate`` [N/s].

    Positive is away from the palm; the push stays. Returns the largest share of friction used.
    """
    dt, used = 0.02, 0.0
    count = max(round(abs(force - start) / (rate * dt)), 1)
    for k in range(1, count + 1):
        now = start + (force - start) * k / count
        angle = float(hand.plant.object_pose[2])
        hand.plant.push(-now * math.sin(angle), now * math.cos(angle))
        used = max(used, float(hand.watch(dt).slip.max()))
    return used


@dataclass(frozen=True)
class Seen:
    """The truth, tick by tick."""

    t: NDArray[np.float64]  # s
    force: NDArray[np.float64]  # N [n, 2]
    angle: NDArray[np.float64]  # rad
    slip: NDArray[np.float64]  # |T|/μN, the greater of both tips

    def since(self, index: int) -> Seen:
        """From this tick on."""
        return Seen(self.t[index:], self.force[index:], self.angle[index:], self.slip[index:])

    def settled(self, off: NDArray[np.bool_]) -> float:
        """Time until nothing is ``off`` any more [s]."""
        where = np.flatnonzero(off)
        return float(self.t[where[-1]] - self.t[0]) if len(where) else 0.0


class Watched:
    """A daemon on virtual time, its hand's truth recorded."""

    def __init__(self, sections: dict[str, dict[str, Any]]) -> None:
        settings = Settings.model_validate(sections | {"loop": {"clock": "virtual"}})
        self._daemon = Daemon(settings, wire=False)
        assert self._daemon.hand is not None
        assert self._daemon.prediction is not None
        self.plant = self._daemon.hand
        self.prediction = self._daemon.prediction
        self._friction = settings.simulation.tip_friction

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self._daemon.close()

    @property
    def now(self) -> float:
        """The clock's time [s]."""
        return self._daemon.clock.now()

    @property
    def mode(self) -> str:
        """The hand's mode."""
        return self._daemon.loop.state.mode

    def command(self, name: str, **numbers: float) -> None:
        """Carry out a command."""
        self._daemon.loop.command({"command": name, **numbers})

    def grasp(self, force: float) -> None:
        """Arm and start to grasp."""
        self._daemon.loop.advance(0.3)
        self.command("arm")
        self._daemon.loop.advance(0.2)
        self.command("grasp", force=force)

    def watch(self, seconds: float) -> Seen:
        """Go on for ``seconds``; the truth at each tick."""
        return Seen(*(np.array(column) for column in zip(*self._ticks(seconds), strict=True)))

    def _ticks(self, seconds: float) -> Iterator[tuple[float, tuple[float, ...], float, float]]:
        loop, plant = self._daemon.loop, self.plant
        for _ in range(max(round(seconds / loop.period), 1)):
            loop.advance(loop.period)
            normal = self._friction * np.maximum(plant.normal, 1e-9)
            used = np.where(plant.normal > 0.1, np.abs(plant.tangential) / normal, 0.0)
            yield self.now, tuple(plant.force), float(plant.object_pose[2]), float(used.max())
