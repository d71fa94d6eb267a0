"""A simulated hand on virtual time that grips, and the plant's word for what its tips do.

The true force, the object's place and slips are judged by the plant at every tick, with nothing of
the code that is measured.
"""

from __future__ import annotations

import contextlib
import gc
import math
import random
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any, Self

from softfinger.daemon.errors import Refused
from softfinger.daemon.simulation.faults import OBJECT, parse_faults
from softfinger.daemon.types import FINGERS
from softfinger.tools.benchmarks.rigs import Sections, merged
from softfinger.tools.watched import Watched

TOO_MUCH = 1.3  # of the force asked for
GONE = 0.1  # m that an object has slid: beyond, it no longer matters how far
_TORQUE_ERROR = 0.1  # share by which the joints' torque constant may be off
_RAISED = 1.25  # of the goal currents before: a firmer grip
_LAST = 0.5  # s over which the force has settled
_SLIPS = 0.999  # of what friction bears


class Watch:
    """The true forces and the object's place, tick by tick."""

    def __init__(self, asked: float, too_much: float = TOO_MUCH) -> None:
        self.asked = asked  # N
        self.too_much = too_much  # of that
        self.peak = 0.0  # force over what is asked for, of either tip
        self.above = 0.0  # longest time above `too_much` [s]
        self.slid = 0.0  # by how much the object was displaced with torque on [m]
        self._mean: list[tuple[float, float]] = []  # when [s], force over what is asked for
        self._below = math.inf  # since then above
        self._place: Sequence[float] = ()

    def see(self, t: float, forces: Sequence[float], place: Sequence[float], torque: bool) -> None:
        """Take in time [s], both tips' forces [N], the object's place [m], whether torque is on."""
        ratios = [force / self.asked for force in forces]
        self._mean.append((t, fmean(ratios)))
        self.peak = max(self.peak, *ratios)
        self._below = min(self._below, t) if max(ratios) > self.too_much else math.inf
        self.above = max(self.above, t - self._below)
        self._place = self._place or place
        if torque:
            self.slid = min(max(self.slid, math.dist(place, self._place)), GONE)

    def settled(self) -> float:
        """Return the mean force over what is asked for, in the end."""
        end = self._mean[-1][0] - _LAST
        return fmean(ratio for t, ratio in self._mean if t > end)

    def first_off(self, share: float) -> float:
        """Return when the mean force, once it was near, was off by more than ``share`` [s]."""
        came = False
        for t, ratio in self._mean:
            near = abs(ratio - 1.0) <= share
            if came and not near:
                return t
            came = came or near
        return math.inf


class VirtualGrip(Watched):
    """A grip; ``look`` is called after each tick."""

    def __init__(self, daemon: Sections, hand: Sections | None = None, torque: float = 1.0) -> None:
        """``hand``: of other settings; ``torque``: its torque constant over the settings'."""
        self.alarms: list[tuple[float, str]] = []  # warnings and errors: when [s], kind
        super().__init__(merged(daemon, {}), None if hand is None else merged(hand, {}))
        self.plant.plant.parameters.torque_constant *= torque
        self.look: Callable[[], None] = lambda: None
        self.loop.heartbeat = lambda _: self.look()
        self.loop.advance(0.1)

    @classmethod
    def drawn(cls, seed: int, chance: random.Random, sections: Sections) -> Self:
        """Return a grip whose mass and torque constant are drawn."""
        drawn = {"seed": seed, "object_mass": 0.1 * 2.0 ** chance.uniform(-1.0, 1.0)}
        error = chance.uniform(-_TORQUE_ERROR, _TORQUE_ERROR)
        return cls(merged(sections, {"simulation": drawn}), torque=1.0 + error)

    def _note(self, *event: str) -> None:
        super()._note(*event)
        level, kind, _ = event
        if level != "info":
            self.alarms.append((self.now, kind))

    def __exit__(self, *ended: object) -> None:
        super().__exit__(*ended)
        gc.collect()  # a daemon refers to itself, with megabytes of frames

    def command(self, name: str, **numbers: float) -> dict[str, Any]:
        """Give a command, which the hand may refuse."""
        with contextlib.suppress(Refused):
            return super().command(name, **numbers)
        return {}

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
                self.plant.load(**{kind: value})
            else:
                faults = self.plant.measurement_faults[FINGERS.index(part)]
                faults.begin(kind, value, self.state.t + after, over)

    def watched(self, asked: float) -> Watch:
        """Return a watch that sees each tick from now on."""
        watch, hand, state = Watch(asked), self.plant, self.state
        self.look = lambda: watch.see(
            state.t, hand.force.tolist(), hand.object_pose[:2].tolist(), state.torque
        )
        return watch

    def answer(self, words: str, seconds: float) -> float:
        """Return the time from the slip that ``words`` cause to raised goal currents [s].

        NaN where nothing slips in ``seconds``, infinity without an answer.
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

    def along(self) -> list[float]:
        """Return each tip's place along the object's faces, from their middle [m]."""
        x, y, angle = self.plant.object_pose.tolist()
        sine, cosine = math.sin(angle), math.cos(angle)
        tips = (self.plant.plant.fingers[k] for k in range(2))
        return [(tip.y - y) * cosine - (tip.x - x) * sine for tip in tips]

    def between(self) -> bool:
        """Return whether the object is between the tips: both press on it."""
        return min(self.plant.force.tolist()) > 0.0 and not self.plant.on_other_tip.any()

    def _slips(self) -> bool:
        most = _SLIPS * self.settings.simulation.tip_friction
        tips = zip(self.plant.tangential.tolist(), self.plant.normal.tolist(), strict=True)
        return any(abs(along) >= most * normal for along, normal in tips)
