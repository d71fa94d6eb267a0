"""What goes out to subscribers on which tick, and how often that really was.

Holds the decimation of the published topics. It sends through `wire.publisher` and looks at what
the loop shows it; it changes nothing there.
"""

from __future__ import annotations

from dataclasses import dataclass

from softfinger.daemon.loop.rates import Schedule
from softfinger.daemon.loop.timing import Statistics
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, Parts, State, Truth
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import Publisher, bit
from softfinger.daemon.wire.schema import Rates

_STATE, _TACTILE, _STATS, _INPUT, _TRUTH = map(
    bit, (schema.STATE, schema.TACTILE, schema.STATS, schema.INPUT, schema.TRUTH)
)


@dataclass(slots=True)
class _Counts:
    """Things that have happened until time ``t`` [s]."""

    t: float = 0.0
    ticks: int = 0
    states: int = 0
    maps: int = 0
    left: int = 0
    right: int = 0


def parts(settings: Settings) -> Parts:
    """What the scene of these settings has."""
    return Parts(
        fingers=("left" in settings.scene.fingers, "right" in settings.scene.fingers),
        servos=settings.servos.backend != "none",
        sensors=settings.tactile.backend != "none",
    )


class Broadcast:
    """Publishes what is due at a tick and wanted by somebody."""

    def __init__(
        self,
        settings: Settings,
        publisher: Publisher,
        perceptions: list[FingerPerception],
        statistics: Statistics,
    ) -> None:
        self._publisher = publisher
        self._perceptions = perceptions
        self._statistics = statistics
        self._schedule = Schedule(settings)
        self._period = 1.0 / settings.loop.rate
        self._scene = parts(settings)
        self.truth: Truth | None = None  # a simulated hand's
        self._numbers = [0, 0]  # frames of each finger that went out
        self._seen: list[Frame | None] = [None, None]  # newest of each finger
        self._published = [-1, -1]  # of which n frames one went out, for each finger
        self._states = self._maps = 0  # messages that went out
        self._told = _Counts()  # when the rates were last told

    def __call__(self, state: State) -> None:
        """All that is due at this tick."""
        publisher, schedule, seq = self._publisher, self._schedule, state.seq
        wanted = publisher.wanted
        if wanted & _TACTILE:
            for perception in self._perceptions:
                if perception.frame is not self._seen[perception.finger]:
                    self._frame(state, perception)
        if wanted & _INPUT:  # behind the frames, which it refers to
            frames: list[Frame | None] = [None, None]
            for perception in self._perceptions:
                frames[perception.finger] = perception.frame
            publisher.input(state, (frames[0], frames[1]))
        if schedule.state.due(seq):
            if wanted & _STATE:
                self._states += 1
                publisher.state(state, self._scene, schedule.state.every)
            if wanted & _TRUTH and self.truth is not None:
                publisher.truth(state, self.truth, schedule.state.every)
        if schedule.stats.due(seq):
            rates = self._rates(state)
            if wanted & _STATS:
                publisher.stats(state, self._period, rates, self._statistics, schedule.stats.every)

    def _frame(self, state: State, perception: FingerPerception) -> None:
        frame = self._seen[perception.finger] = perception.frame
        every = self._schedule.tactile_every
        if frame is None or frame.seq // every == self._published[perception.finger]:
            return
        self._published[perception.finger] = frame.seq // every
        self._numbers[perception.finger] += 1
        self._maps += 1
        wall = state.wall - (state.t - frame.t_sample)
        data = perception.shown(frame)
        number = self._numbers[perception.finger]
        self._publisher.tactile(
            frame, data, perception.finger, perception.facts, wall, every, number
        )

    def _rates(self, state: State) -> Rates:
        """Rates [Hz] since they were last asked for, by the machine's time."""
        frames = [0, 0]
        for perception in self._perceptions:
            frames[perception.finger] = perception.frames
        last = self._told
        t = state.t + state.timing.behind_s
        now = self._told = _Counts(t, state.seq, self._states, self._maps, *frames)
        per = 1.0 / (now.t - last.t) if now.t > last.t else 0.0
        return Rates(
            tick=per * (now.ticks - last.ticks),
            left=per * (now.left - last.left),
            right=per * (now.right - last.right),
            state=per * (now.states - last.states),
            tactile=per * (now.maps - last.maps),
        )
