"""Provide hands for benchmarks: settings of tips and sensors, and grips in virtual time.

Grips observe the plant on every tick. True force, object position and slip are read from the plant,
independently of the code under test.
"""

from __future__ import annotations

import contextlib
import gc
import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, Self

from softfinger.daemon.errors import Refused, SoftfingerError
from softfinger.daemon.profile.load import load
from softfinger.daemon.simulation.faults import parse_faults
from softfinger.daemon.types import State
from softfinger.tools.simulated_daemon import SimulatedDaemon

Sections = Mapping[str, Mapping[str, Any]]

SOLID: Sections = {  # tips of solid rubber
    "tip": {"physics": "solid"},
    "material": {"law": "constant", "modulus": 0.15e6},
    "safety": {"d_max": 0.008},
}
SENSORS: dict[str, Sections] = {  # sensors with defects; the ideal sensor adds only noise
    name: load(Path(name)).model_dump(exclude_unset=True) for name in ("velostat", "capacitive")
}
EXCESS_RATIO = 1.3  # a force above this multiple of the requested force is excessive
LOST_SLIDE = 0.1  # displacement along the object's faces that counts as a loss [m]
_TORQUE_ERROR = 0.1  # maximum relative error of the torque constant
# Ratio of the goal current to its value before the fault; above this ratio, the daemon has reacted.
_INCREASED_RATIO = 1.25
_AVERAGING_TIME = 0.5  # time at the end of the hold over which the force is averaged [s]
_SLIP_FRACTION = 0.999  # fraction of the friction limit above which a tip counts as slipping
_EVENT_PREFIX = "consistency."  # prefix of the event kinds that report a faulty measurement


@dataclass(frozen=True)
class GripCase:
    """Grip at ``force`` [N] with a faulty hand, or with a hand that differs from the settings.

    ``words`` are faults in the syntax of `softfinger emulate --fault`. The faults start while the
    object is held. If ``before`` is True, the faults start before the grasp.
    """

    name: str
    force: float  # requested force [N]
    # Settings that differ between the hand and the daemon.
    hand: Sections = field(default_factory=dict)
    daemon: Sections = field(default_factory=dict)
    torque: float = 1.0  # ratio of the true torque constant to its setting
    words: str = ""
    before: bool = False
    false: tuple[str, ...] = ()  # channels that may be reported as faulty
    aim: str = ""  # pass criterion
    then: float = 0.0  # second requested force [N]
    load: float = 0.0  # load along the faces [N]
    within: float = 0.0  # duration of the load ramp [s]
    turn: float = 0.0  # commanded object angle [rad]
    tares: bool = False  # True if the sensors are tared before the grip


class RigError(SoftfingerError):
    """Error raised if a test rig fails, so that a measurement is impossible."""


def merged(sections: Sections, base: Sections) -> dict[str, dict[str, Any]]:
    """Return ``base`` updated with ``sections``."""
    return {k: {**base.get(k, {}), **sections.get(k, {})} for k in {**base, **sections}}


def must_hold(state: State) -> None:
    """Raise RigError unless the hand is holding an object."""
    if state.mode != "holding":
        raise RigError(f"the hand failed to grip the object: {state.mode} {state.fault}")


def diagnoses(alarms: Iterable[tuple[float, str]]) -> list[tuple[float, str]]:
    """Return the time and the channel of each alarm that reports a faulty measurement."""
    return [(t, k.removeprefix(_EVENT_PREFIX)) for t, k in alarms if k.startswith(_EVENT_PREFIX)]


class Watch:
    """Record true forces and object position on every tick."""

    def __init__(self, asked: float, too_much: float = EXCESS_RATIO) -> None:
        self.asked = asked  # requested force [N]
        self.too_much = too_much  # force limit relative to the requested force
        self.peak = 0.0  # maximum force relative to the requested force
        self.above = 0.0  # longest time above `too_much` [s]
        self.slid = 0.0  # object displacement while torque is on [m]
        self.raised = False  # True if the goal force was above the requested force
        # Pairs of time [s] and force relative to the requested force.
        self._mean: list[tuple[float, float]] = []
        self._below = math.inf  # time at which the force last rose above the limit [s]
        self._place: Sequence[float] = ()

    def see(
        self, t: float, forces: Sequence[float], place: Sequence[float], torque: bool, goal: float
    ) -> None:
        """Record time [s], tip forces [N], object position [m], torque state and goal force [N]."""
        ratios = [force / self.asked for force in forces]
        self._mean.append((t, fmean(ratios)))
        self.peak = max(self.peak, *ratios)
        self._below = min(self._below, t) if max(ratios) > self.too_much else math.inf
        self.above = max(self.above, t - self._below)
        self.raised = self.raised or goal > 1.02 * self.asked
        self._place = self._place or place
        if torque:
            self.slid = min(max(self.slid, math.dist(place, self._place)), LOST_SLIDE)

    def settled(self) -> float:
        """Return the final relative force, averaged over both tips and `_AVERAGING_TIME`."""
        end = self._mean[-1][0] - _AVERAGING_TIME
        return fmean(ratio for t, ratio in self._mean if t > end)

    def first_off(self, share: float) -> float:
        """Return the first time [s] at which the relative force left the range 1 ± ``share``."""
        came = False
        for t, ratio in self._mean:
            near = abs(ratio - 1.0) <= share
            if came and not near:
                return t
            came = came or near
        return math.inf


class VirtualGrip(SimulatedDaemon):
    """Grip in virtual time; ``look`` is called after each tick."""

    def __init__(self, daemon: Sections, hand: Sections | None = None, torque: float = 1.0) -> None:
        """Build daemon and hand.

        ``hand`` contains the hand's settings if they differ from the daemon's settings. ``torque``
        is the true torque constant divided by the configured value.
        """
        self.alarms: list[tuple[float, str]] = []  # time [s] and kind of each warning or error
        super().__init__(merged(daemon, {}), None if hand is None else merged(hand, {}))
        if torque != 1.0:
            self.plant.plant.parameters.torque_constant *= torque
        self.look: Callable[[], None] = lambda: None
        self.loop.heartbeat = lambda _: self.look()
        self.loop.advance(0.1)

    @classmethod
    def drawn(cls, seed: int, chance: random.Random, sections: Sections) -> Self:
        """Create a grip with a random object mass and a random error of the torque constant."""
        drawn = {"seed": seed, "object_mass": 0.1 * 2.0 ** chance.uniform(-1.0, 1.0)}
        error = chance.uniform(-_TORQUE_ERROR, _TORQUE_ERROR)
        return cls(merged(sections, {"simulation": drawn}), torque=1.0 + error)

    def _note(self, level: str, kind: str, text: str) -> None:
        super()._note(level, kind, text)
        if level != "info":
            self.alarms.append((self.now, kind))

    def __exit__(self, *ended: object) -> None:
        super().__exit__(*ended)
        gc.collect()  # Collect the daemon's reference cycles, which keep frames in memory.

    def command(self, name: str, **numbers: float) -> dict[str, Any]:
        """Send a command and ignore refusals."""
        with contextlib.suppress(Refused):
            return super().command(name, **numbers)
        return {}

    def until(self, mode: str, seconds: float) -> bool:
        """Advance until the hand is in ``mode``; return False after a timeout of ``seconds``."""
        end = self.state.t + seconds
        while self.state.mode != mode and self.state.t < end:
            self.loop.advance(self.loop.period)
        return self.state.mode == mode

    def begin(self, words: str) -> float:
        """Start faults in `softfinger emulate --fault` syntax; return how long they develop [s]."""
        events = parse_faults(words.split(), ())
        for event in events:
            self.plant.apply_fault(event._replace(after=self.state.t + event.after))
        return max((event.over for event in events), default=0.0)

    def watched(self, asked: float, too_much: float = EXCESS_RATIO) -> Watch:
        """Start recording each tick, and return the `Watch`."""
        watch, hand, state = Watch(asked, too_much), self.plant, self.state
        self.look = lambda: watch.see(
            state.t,
            hand.force.tolist(),
            hand.object_pose[:2].tolist(),
            state.torque,
            state.goal.force,
        )
        return watch

    def pull(self, load: float, seconds: float, steps: int) -> None:
        """Increase the load along the object's faces to ``load`` [N] in ``steps`` steps."""
        for k in range(steps):
            self.plant.load(push=load * (k + 1) / steps)
            self.loop.advance(seconds / steps)

    def answer(self, words: str, seconds: float) -> float:
        """Start the faults ``words``; return the time [s] from slip to increased goal currents.

        Return NaN if no tip slips within ``seconds``, and infinity if there is no reaction.
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
            if sum(state.goal.current) > _INCREASED_RATIO * calm:
                answered = min(answered, state.t)
        return answered - onset if onset < math.inf else math.nan

    def along(self) -> list[float]:
        """Return the tip positions [m] along the object faces, relative to the object's centre."""
        x, y, angle = self.plant.object_pose.tolist()
        sine, cosine = math.sin(angle), math.cos(angle)
        tips = (self.plant.plant.fingers[k] for k in range(2))
        return [(tip.y - y) * cosine - (tip.x - x) * sine for tip in tips]

    def between(self) -> bool:
        """Return True if the object is between the tips, i.e. both tips press on it."""
        return min(self.plant.force.tolist()) > 0.0 and not self.plant.on_other_tip.any()

    def _slips(self) -> bool:
        most = _SLIP_FRACTION * self.settings.simulation.tip_friction
        tips = zip(self.plant.tangential.tolist(), self.plant.normal.tolist(), strict=True)
        return any(abs(along) >= most * normal for along, normal in tips)
